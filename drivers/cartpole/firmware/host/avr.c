/* The AVR image under simavr, one millisecond for each call, as a shared library for avr_device.py.
 *
 * Inputs: encoders, limit switches and the host's bytes. Outputs: bytes, the mean of the motor's PWM and the lamps.
 * Edges of the encoders are spread evenly over the millisecond; bytes arrive at 1 Mbaud.
 */
#include <stdarg.h>
#include <stdio.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include <simavr/avr_eeprom.h>
#include <simavr/avr_ioport.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>
#include <simavr/sim_io.h>

#define CYCLES_PER_MS 16000
#define CYCLES_PER_BYTE 160
#define GPIOR0 0x3E
#define TCCR1A 0x80
#define OCR1A 0x88
#define COM1A1 0x80

typedef struct {
    const char pins[2][2]; /* Port and bit of A and B. */
    uint8_t at;            /* 0 to 3 along the cycle. */
    int32_t left, every;
    avr_irq_t *irq[2];
} encoder;

typedef struct {
    avr_t *avr;
    uint64_t end;
    encoder cart, pole;
    avr_irq_t *left, *right, *uart;
    const uint8_t *rx;
    uint32_t rx_left;
    uint8_t tx[1024];
    uint32_t tx_length;
    uint64_t step_began;
    uint32_t longest_step;
    uint64_t pwm_since, asleep;
    int32_t pwm;
    int64_t pwm_sum; /* Times cycles. */
} board;

typedef struct {
    double pwm;             /* Mean over the millisecond, -799 to 799. */
    int32_t armed, set_pole;
    uint32_t longest_step;  /* Most cycles from the start of a control step to its end, in this call. */
    uint32_t asleep;        /* Idle cycles. */
    uint32_t complaints;    /* Errors of the simulator in this call, such as a byte that came too early. */
    int32_t crashed;
} board_outputs;

static uint32_t complaints;

/* The simulator prints a line for each byte that the chip is too slow to read; these are counted. */
static void count(avr_t *avr, const int level, const char *format, va_list words)
{
    (void)avr;
    (void)format;
    (void)words;
    complaints += level == LOG_ERROR;
}

static void no_sleep(avr_t *avr, avr_cycle_count_t cycles)
{
    ((board *)avr->custom.data)->asleep += cycles;
}

static int32_t pwm_now(const avr_t *avr)
{
    int32_t pwm = avr->data[OCR1A] | avr->data[OCR1A + 1] << 8;
    if (!(avr->data[TCCR1A] & COM1A1))
        return 0;
    return avr->data[0x25] & 1 ? -pwm : pwm; /* PORTB, bit 0: reverse. */
}

static void settle_pwm(board *b)
{
    b->pwm_sum += (int64_t)b->pwm * (int64_t)(b->avr->cycle - b->pwm_since);
    b->pwm_since = b->avr->cycle;
    b->pwm = pwm_now(b->avr);
}

static void marked(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param)
{
    board *b = param;
    avr->data[address] = value;
    if (value) {
        b->step_began = avr->cycle;
    } else {
        if (avr->cycle - b->step_began > b->longest_step)
            b->longest_step = (uint32_t)(avr->cycle - b->step_began);
        settle_pwm(b);
    }
}

static void sent(avr_irq_t *irq, uint32_t value, void *param)
{
    board *b = param;
    (void)irq;
    if (b->tx_length < sizeof b->tx)
        b->tx[b->tx_length++] = (uint8_t)value;
}

static void show(encoder *e)
{
    /* A leads B: 00, 10, 11, 01 as (A, B). */
    avr_raise_irq(e->irq[0], e->at == 1 || e->at == 2);
    avr_raise_irq(e->irq[1], e->at == 2 || e->at == 3);
}

static avr_cycle_count_t turn(avr_t *avr, avr_cycle_count_t when, void *param)
{
    encoder *e = param;
    (void)avr;
    e->at = (uint8_t)((e->at + (e->left > 0 ? 1 : 3)) & 3);
    e->left += e->left > 0 ? -1 : 1;
    show(e);
    return e->left ? when + (avr_cycle_count_t)e->every : 0;
}

static avr_cycle_count_t deliver(avr_t *avr, avr_cycle_count_t when, void *param)
{
    board *b = param;
    (void)avr;
    avr_raise_irq(b->uart, *b->rx++);
    return --b->rx_left ? when + CYCLES_PER_BYTE : 0;
}

static void move(board *b, encoder *e, int32_t counts)
{
    e->left += counts;
    if (e->left == 0) {
        avr_cycle_timer_cancel(b->avr, turn, e);
        return;
    }
    e->every = CYCLES_PER_MS / (e->left < 0 ? -e->left : e->left);
    avr_cycle_timer_register(b->avr, (avr_cycle_count_t)e->every / 2 + 1, turn, e);
}

static avr_cycle_count_t wake(avr_t *avr, avr_cycle_count_t when, void *param)
{
    (void)avr;
    (void)when;
    (void)param;
    return 0;
}

static avr_irq_t *pin(avr_t *avr, char port, int bit)
{
    return avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ(port), bit);
}

void board_close(board *b)
{
    if (b == NULL)
        return;
    if (b->avr != NULL) {
        avr_terminate(b->avr);
        free(b->avr);
    }
    free(b);
}

board *board_open(const char *elf, uint8_t *eeprom, uint32_t length)
{
    elf_firmware_t firmware;
    avr_eeprom_desc_t stored = {eeprom, 0, length};
    uint32_t flags = 0;
    board *b = calloc(1, sizeof *b);
    avr_global_logger_set(count);
    memset(&firmware, 0, sizeof firmware);
    if (b == NULL || elf_read_firmware(elf, &firmware) != 0 || (b->avr = avr_make_mcu_by_name("atmega328p")) == NULL) {
        free(b);
        return NULL;
    }
    avr_init(b->avr);
    b->avr->custom.data = b;
    b->avr->frequency = CYCLES_PER_MS * 1000;
    b->avr->sleep = no_sleep;
    avr_load_firmware(b->avr, &firmware);
    b->avr->frequency = CYCLES_PER_MS * 1000;
    avr_ioctl(b->avr, AVR_IOCTL_EEPROM_SET, &stored);
    avr_ioctl(b->avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
    avr_register_io_write(b->avr, GPIOR0, marked, b);
    b->cart.irq[0] = pin(b->avr, 'C', 0);
    b->cart.irq[1] = pin(b->avr, 'C', 1);
    b->pole.irq[0] = pin(b->avr, 'D', 4);
    b->pole.irq[1] = pin(b->avr, 'D', 5);
    b->left = pin(b->avr, 'D', 6);
    b->right = pin(b->avr, 'D', 7);
    b->uart = avr_io_getirq(b->avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT);
    avr_irq_register_notify(avr_io_getirq(b->avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), sent, b);
    b->cart.at = b->pole.at = 2; /* Both pins high, by the pull-ups, before the first edge. */
    show(&b->cart);
    show(&b->pole);
    return b;
}

/* Run a millisecond; return how many bytes were sent, at most as many as out holds (1024). */
uint32_t board_tick(board *b, int32_t cart_counts, int32_t pole_counts, int left, int right, const uint8_t *rx,
                    uint32_t rx_length, uint8_t *out, board_outputs *outputs)
{
    uint64_t began = b->end;
    b->end += CYCLES_PER_MS;
    b->tx_length = 0;
    b->longest_step = 0;
    b->asleep = 0;
    b->pwm_sum = 0;
    b->pwm_since = began;
    complaints = 0;
    move(b, &b->cart, cart_counts);
    move(b, &b->pole, pole_counts);
    avr_raise_irq(b->left, !left); /* Closed switches pull their pins down. */
    avr_raise_irq(b->right, !right);
    b->rx = rx;
    b->rx_left = rx_length;
    if (rx_length)
        avr_cycle_timer_register(b->avr, CYCLES_PER_BYTE, deliver, b);
    outputs->crashed = 0;
    /* A chip that sleeps runs on to the next event, which may lie in the next millisecond. */
    avr_cycle_timer_register(b->avr, b->end > b->avr->cycle ? b->end - b->avr->cycle : 1, wake, b);
    while (b->avr->cycle < b->end && !outputs->crashed) {
        int state = avr_run(b->avr);
        outputs->crashed = state == cpu_Done || state == cpu_Crashed;
    }
    settle_pwm(b);
    outputs->pwm = (double)b->pwm_sum / CYCLES_PER_MS;
    outputs->armed = b->avr->data[0x25] >> 4 & 1;
    outputs->set_pole = b->avr->data[0x25] >> 5 & 1;
    outputs->longest_step = b->longest_step;
    outputs->complaints = complaints;
    outputs->asleep = (uint32_t)b->asleep;
    memcpy(out, b->tx, b->tx_length);
    return b->tx_length;
}
