/* stm32/main.c or encoder.c on this host, with the chip's registers in memory: a shared library for stm32_device.py.
 *
 * Inputs: encoders, limit switches, the host's bytes or frames. Outputs: bytes or frames, the mean of the motor's PWM
 * and the lamps. A millisecond has 100 turns of the main loop; a byte takes one (1 Mbaud), a frame of the bus its bits
 * at 500 kbit/s. Its author is that of main.c, so one wrong idea of the chip can be in both. One chip a process.
 */
#include <string.h>

#define HOST
#include "../stm32/board.c"
#ifdef ENCODER
#include "../stm32/encoder.c"

void usart1_interrupt(void)
{
}

static void forget(void)
{
    memset(counts_before, 0, sizeof counts_before);
}
#else
#include "../stm32/main.c"

static void forget(void)
{
    rx_in = rx_out = tx_in = tx_out = 0;
}
#endif

#define TURNS 100
#define NO_BYTE 0xFFFFFFFFUL
#define BUS_SIZE 1024 /* Frames; a power of two. */
#define MAILBOXES 3
#define UNWRITTEN (1UL << 31) /* A bit of RF0R that the chip does not have: what main.c writes lacks it. */

typedef struct {
    double pwm;               /* Mean over the millisecond, -799 to 799. */
    int32_t armed, set_pole;
    uint32_t unserved_ms;     /* Since the watchdog was reloaded last. */
    uint32_t filtered;        /* Frames on the bus so far that the filter kept from the chip. */
    uint32_t bit_rate;        /* Of its CAN controller [bit/s]. */
} chip_outputs;

static volatile uint32_t peripherals[0x22400 / 4], core[0x1000 / 4], unique[3];
static uint32_t output_bits[3], systick_flag, unserved_ms, filtered;
static uint8_t *sent;
static uint32_t sent_length;
static volatile uint32_t byte_in, byte_out; /* The UART's data register, read and written. */
static bool byte_waits;

/* The CAN controller and the bus. */
static cartpole_can_frame fifo[3], bus[BUS_SIZE], on_wire;
static uint32_t fifo_count, fifo_shown, bus_in, bus_out, order[MAILBOXES], orders;
static bool overflow, silent_bus;
static int32_t wire_us;   /* Until the frame on the wire ends. */
static int from_mailbox;  /* -1: from the host. */

static volatile uint32_t *at(uint32_t address)
{
    if (address >= 0xE000E000UL)
        return &core[(address - 0xE000E000UL) / 4];
    return address < 0x40000000UL ? &unique[(address - 0x1FFFF7E8UL) / 4]
                                  : &peripherals[(address - 0x40000000UL) / 4];
}

/* From here on a register's name is its memory, without the chip's reactions. */
#undef REGISTER
#define REGISTER(address) (*at(address))

static void settle_can(void)
{
    uint32_t i, empty = 0;
    if (CAN_RF0R != fifo_shown) {
        if ((CAN_RF0R & RFOM0) && fifo_count > 0) {
            memmove(fifo, fifo + 1, sizeof fifo - sizeof *fifo);
            fifo_count--;
        }
        if (CAN_RF0R & FOVR0)
            overflow = false;
    }
    fifo_shown = CAN_RF0R = UNWRITTEN | fifo_count | (overflow ? FOVR0 : 0);
    CAN_RI0R = fifo[0].id << 21;
    CAN_RDT0R = fifo[0].length;
    CAN_RDL0R = word(fifo[0].data);
    CAN_RDH0R = word(fifo[0].data + 4);
    CAN_MSR = CAN_MCR & INRQ ? INAK : 0;
    for (i = 0; i < MAILBOXES; i++) {
        bool asked = CAN_TIR(i) & TXRQ;
        if (asked && order[i] == 0)
            order[i] = ++orders;
        if (!asked)
            empty |= TME(i);
    }
    CAN_TSR = empty;
}

static void settle(void)
{
    static const uint32_t ports[] = {GPIOA, GPIOB, GPIOC};
    uint32_t i;
    for (i = 0; i < 3; i++) {
        uint32_t set = GPIO_BSRR(ports[i]);
        output_bits[i] = (output_bits[i] | (set & 0xFFFF)) & ~(set >> 16);
        GPIO_BSRR(ports[i]) = 0;
    }
    if (byte_out != NO_BYTE)
        sent[sent_length++] = (uint8_t)byte_out;
    byte_out = NO_BYTE;
    USART1_SR = TXE | (byte_waits ? RXNE : 0);
    if (IWDG_KR == IWDG_RELOAD)
        unserved_ms = 0;
    IWDG_KR = 0;
    /* The crystal and the multiplier are ready at once. */
    if (RCC_CR & HSEON)
        RCC_CR |= HSERDY;
    if (RCC_CR & PLLON)
        RCC_CR |= PLLRDY;
    settle_can();
}

volatile uint32_t *chip_register(uint32_t address)
{
    static volatile uint32_t read_once;
    if (at(address) == &SYST_CSR && systick_flag) {
        read_once = SYST_CSR | SYST_COUNTFLAG;
        systick_flag = 0;
        return &read_once;
    }
    settle();
    if (at(address) != &USART1_DR)
        return at(address);
    if (!byte_waits)
        return &byte_out;
    byte_waits = false;
    return &byte_in;
}


static void receive_byte(uint8_t byte)
{
    byte_in = byte;
    byte_waits = true;
    if ((USART1_CR1 & RXNEIE) && (NVIC_ISER1 & 1UL << (USART1_IRQ - 32)))
        usart1_interrupt();
    byte_waits = false;
}

static bool passes_filter(const cartpole_can_frame *frame)
{
    uint32_t bank, id = frame->id << 21;
    bool passes = false;
    for (bank = 0; bank < 14; bank++) {
        uint32_t bit = 1UL << bank;
        /* Only banks as these programs use them: an id under a mask of 32 bits, for FIFO 0. */
        bool active = (CAN_FA1R & bit) && (CAN_FS1R & bit) && !(CAN_FM1R & bit) && !(CAN_FFA1R & bit);
        passes |= active && ((id ^ CAN_FR1(bank)) & CAN_FR2(bank)) == 0;
    }
    return passes && !(CAN_FMR & FINIT);
}

/* Worst case, with a stuff bit after every four bits. */
static int32_t duration_us(const cartpole_can_frame *frame)
{
    uint32_t bits = 44 + 8U * frame->length;
    return (int32_t)(2 * (bits + (bits - 11) / 4 + 3));
}

static void begin_frame(void)
{
    uint32_t i, first = MAILBOXES;
    /* Without TXFP the lowest id leaves first, whenever it was asked for. */
    for (i = 0; i < MAILBOXES; i++)
        if (order[i] != 0 && (first == MAILBOXES || (CAN_MCR & TXFP ? order[i] < order[first]
                                                                     : CAN_TIR(i) < CAN_TIR(first))))
            first = i;
    from_mailbox = -1;
    if (first < MAILBOXES) {
        uint32_t k, low = CAN_TDLR(first), high = CAN_TDHR(first);
        cartpole_can_frame frame = {CAN_TIR(first) >> 21, 0, {0}, {0}};
        frame.length = (uint8_t)(CAN_TDTR(first) & 15);
        for (k = 0; k < 4; k++) {
            frame.data[k] = (uint8_t)(low >> 8 * k);
            frame.data[4 + k] = (uint8_t)(high >> 8 * k);
        }
        /* The lower id wins the bus. */
        if (bus_out == bus_in || frame.id < bus[bus_out].id) {
            from_mailbox = (int)first;
            on_wire = frame;
        }
    }
    if (from_mailbox < 0) {
        if (bus_out == bus_in)
            return;
        on_wire = bus[bus_out];
        bus_out = (bus_out + 1) & (BUS_SIZE - 1);
    }
    wire_us = duration_us(&on_wire);
}

static void end_frame(void)
{
    if (from_mailbox >= 0) {
        if (silent_bus) /* Nobody acknowledges: it is repeated. */
            return;
        CAN_TIR((uint32_t)from_mailbox) &= ~TXRQ;
        order[from_mailbox] = 0;
        memcpy(sent + sent_length, &on_wire, sizeof on_wire);
        sent_length += sizeof on_wire;
    } else if (!passes_filter(&on_wire)) {
        filtered++;
    } else if (fifo_count == 3) {
        overflow = true;
        fifo[2] = on_wire;
    } else {
        fifo[fifo_count++] = on_wire;
    }
}

static void run_bus(void)
{
    if (!(RCC_APB1ENR & CANEN) || CAN_MCR & INRQ)
        return;
    settle_can();
    if (wire_us > 0) {
        if ((wire_us -= 1000 / TURNS) <= 0)
            end_frame();
    } else {
        begin_frame();
    }
}

/* Start a chip: its settings page, the jumper BOOT1. */
void chip_start(const uint8_t *page, uint32_t length, int boot1)
{
    memset((void *)peripherals, 0, sizeof peripherals);
    memset((void *)core, 0, sizeof core);
    memset(&stored, 0xFF, sizeof stored); /* As an erased flash. */
    memcpy(&stored, page, length < sizeof stored ? length : sizeof stored);
    unique[0] = 0x11111111;
    unique[1] = 0x00300000;
    unique[2] = 0x00000004;
    memset(output_bits, 0, sizeof output_bits);
    memset(order, 0, sizeof order);
    memset(fifo, 0, sizeof fifo);
    systick_flag = unserved_ms = filtered = fifo_count = fifo_shown = bus_in = bus_out = orders = 0;
    overflow = silent_bus = byte_waits = false;
    wire_us = 0;
    byte_out = NO_BYTE;
    forget();
    queue_in = queue_out = 0;
    was_off = false;
    GPIO_IDR(GPIOB) = 0xFFFF & ~(boot1 ? 0UL : 1UL << BOOT1);
    set_up();
}

/* Faults of the bus: nobody acknowledges; the controller's error register; a frame found its FIFO full. */
void chip_bus(int silent, uint32_t errors, int overrun)
{
    silent_bus = silent != 0;
    CAN_ESR = errors;
    overflow = overrun != 0;
}

/* Run a millisecond; return how many bytes were sent, which out must hold (4096). */
uint32_t chip_tick(int32_t cart_counts, int32_t pole_counts, int left, int right, const uint8_t *data,
                   uint32_t length, uint8_t *out, chip_outputs *outputs)
{
    int32_t turn, cart_done = 0, pole_done = 0, pwm_sum = 0;
    sent = out;
    sent_length = 0;
    GPIO_IDR(GPIOB) |= 1UL << LEFT_SWITCH | 1UL << RIGHT_SWITCH;
    GPIO_IDR(GPIOB) &= ~(left ? 1UL << LEFT_SWITCH : 0) & ~(right ? 1UL << RIGHT_SWITCH : 0);
    bool on_can = RCC_APB1ENR & CANEN;
    if (on_can)
        for (; length >= sizeof *bus; length -= sizeof *bus, data += sizeof *bus) {
            memcpy(bus + bus_in, data, sizeof *bus);
            bus_in = (bus_in + 1) & (BUS_SIZE - 1);
        }
    systick_flag = SYST_CSR & 1;
    unserved_ms++;
    for (turn = 0; turn < TURNS; turn++) {
        int32_t cart_now = cart_counts * (turn + 1) / TURNS, pole_now = pole_counts * (turn + 1) / TURNS;
        if (TIM_CR1(TIM2) & CEN)
            TIM_CNT(TIM2) = (TIM_CNT(TIM2) + (uint32_t)(cart_now - cart_done)) & 0xFFFF;
        if (TIM_CR1(TIM4) & CEN)
            TIM_CNT(TIM4) = (TIM_CNT(TIM4) + (uint32_t)(pole_now - pole_done)) & 0xFFFF;
        cart_done = cart_now;
        pole_done = pole_now;
        if (!on_can && length > 0 && turn < TURNS - 1) {
            receive_byte(*data++);
            length--;
        }
        SYST_CVR = SYST_RVR - SYST_RVR / TURNS * (uint32_t)turn;
        run_bus();
        step();
        settle();
        pwm_sum += (int32_t)TIM_CCR1(TIM3) * (output_bits[0] >> MOTOR_REVERSE & 1 ? -1 : 1);
    }
    outputs->pwm = (double)pwm_sum / TURNS;
    outputs->armed = output_bits[1] >> LED_ARMED & 1;
    outputs->set_pole = !(output_bits[2] >> LED_SET_POLE & 1);
    outputs->unserved_ms = unserved_ms;
    outputs->filtered = filtered;
    outputs->bit_rate = APB1_KHZ * 1000 / ((CAN_BTR & 0x3FF) + 1) / ((CAN_BTR >> 16 & 15) + (CAN_BTR >> 20 & 7) + 3);
    return sent_length;
}
