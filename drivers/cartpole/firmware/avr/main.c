/* The cart-pole's firmware on an ATmega328P at 16 MHz (Arduino Uno, Nano). Pins: docs/how-to/firmware.md. */
#include <avr/eeprom.h>
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/pgmspace.h>
#include <avr/sleep.h>
#include <avr/wdt.h>

#include "../rig.h"

#define RX_SIZE 64   /* Both powers of two. */
#define TX_SIZE 128

#define MOTOR_PWM _BV(PB1)
#define MOTOR_REVERSE _BV(PB0)
#define LED_ARMED _BV(PB4)
#define LED_SET_POLE _BV(PB5)
#define CART_A_B (_BV(PC0) | _BV(PC1))
#define POLE_A_B (_BV(PD4) | _BV(PD5))
#define LEFT_SWITCH _BV(PD6)
#define RIGHT_SWITCH _BV(PD7)

/* The settings in EEPROM, from address 0, CRC-16/IBM-3740 last; without them the nominal ones apply. */
typedef struct {
    rig_settings settings;
    uint16_t crc;
} stored_settings;

static volatile uint8_t rx[RX_SIZE], rx_in;
static uint8_t rx_out;
static uint8_t tx[TX_SIZE], tx_in;
static volatile uint8_t tx_out;
static volatile int16_t cart_counts, pole_counts;
static volatile uint8_t ticks_due, lost_counts;
static uint8_t cart_pins, pole_pins;
static rig robot;

/* Steps of a quadrature encoder by old and new pins (old A B, new A B); 2: one was missed. */
static const int8_t steps[16] = {0, 1, -1, 2, -1, 0, 2, 1, 1, 2, 0, -1, 2, -1, 1, 0};

ISR(PCINT1_vect)
{
    uint8_t now = PINC & 3;
    int8_t step = steps[(uint8_t)(cart_pins << 2) | now];
    cart_pins = now;
    if (step == 2)
        lost_counts = 1;
    else
        cart_counts += step;
}

ISR(PCINT2_vect)
{
    uint8_t now = (PIND >> 4) & 3;
    int8_t step = steps[(uint8_t)(pole_pins << 2) | now];
    pole_pins = now;
    if (step == 2)
        lost_counts = 1;
    else
        pole_counts += step;
}

ISR(TIMER2_COMPA_vect)
{
    ticks_due++;
}

ISR(USART_RX_vect)
{
    uint8_t byte = UDR0, next = (uint8_t)((rx_in + 1) & (RX_SIZE - 1));
    rx[rx_in] = byte;
    if (next != rx_out)
        rx_in = next;
}

ISR(USART_UDRE_vect)
{
    UDR0 = tx[tx_out];
    tx_out = (uint8_t)((tx_out + 1) & (TX_SIZE - 1));
    if (tx_out == tx_in)
        UCSR0B &= (uint8_t)~_BV(UDRIE0);
}

/* Queue a frame, or drop it if it does not fit: half a frame would also corrupt the next one. */
static void send(const uint8_t *frame, uint8_t length)
{
    uint8_t room = (uint8_t)((tx_out - tx_in - 1) & (TX_SIZE - 1));
    if (length == 0 || length > room)
        return;
    for (; length; length--) {
        tx[tx_in] = *frame++;
        tx_in = (uint8_t)((tx_in + 1) & (TX_SIZE - 1));
    }
    UCSR0B |= _BV(UDRIE0);
}

static void drive(int16_t pwm)
{
    if (pwm < 0) {
        PORTB |= MOTOR_REVERSE;
        pwm = -pwm;
    } else {
        PORTB &= (uint8_t)~MOTOR_REVERSE;
    }
    /* A compare value of 0 would still give one clock of every 800, so the pin is taken off the timer. */
    if (pwm)
        TCCR1A |= _BV(COM1A1);
    else
        TCCR1A &= (uint8_t)~_BV(COM1A1);
    OCR1A = (uint16_t)pwm;
}

static void load(rig_settings *settings)
{
    static const rig_settings nominal = {{CARTPOLE_ONE, CARTPOLE_ONE, CARTPOLE_ONE, CARTPOLE_ONE, 1, 0}, 16000};
    stored_settings stored;
    eeprom_read_block(&stored, (const void *)0, sizeof stored);
    *settings = cartpole_crc((const uint8_t *)&stored.settings, sizeof stored.settings) == stored.crc ? stored.settings
                                                                                                  : nominal;
}

static void set_up(void)
{
    DDRB = MOTOR_PWM | MOTOR_REVERSE | LED_ARMED | LED_SET_POLE;
    PORTC = CART_A_B; /* Pull-ups. */
    PORTD = POLE_A_B | LEFT_SWITCH | RIGHT_SWITCH;
    /* Timer 1: fast PWM up to ICR1 at 20 kHz on OC1A. */
    ICR1 = RIG_PWM_TOP;
    TCCR1A = _BV(WGM11);
    TCCR1B = _BV(WGM13) | _BV(WGM12) | _BV(CS10);
    /* Timer 2: 16 MHz / 64 / 250 = 1 kHz. */
    OCR2A = 249;
    TCCR2A = _BV(WGM21);
    TCCR2B = _BV(CS22);
    TIMSK2 = _BV(OCIE2A);
    /* UART: 16 MHz / 8 / 2 = 1 Mbaud, 8N1. */
    UCSR0A = _BV(U2X0);
    UBRR0 = 1;
    UCSR0B = _BV(RXEN0) | _BV(TXEN0) | _BV(RXCIE0);
    cart_pins = PINC & 3;
    pole_pins = (PIND >> 4) & 3;
    PCMSK1 = CART_A_B;
    PCMSK2 = POLE_A_B;
    PCICR = _BV(PCIE1) | _BV(PCIE2);
    set_sleep_mode(SLEEP_MODE_IDLE);
    /* If the control loop hangs, the chip is reset, which switches the motor off. */
    wdt_enable(WDTO_60MS);
    sei();
}

static void tick(void)
{
    uint8_t frame[CARTPOLE_MAX_FRAME], switches;
    rig_inputs inputs;
    int16_t pwm;
    cli();
    ticks_due--;
    inputs.cart_counts = cart_counts;
    inputs.pole_counts = pole_counts;
    inputs.lost_counts = lost_counts;
    lost_counts = 0;
    sei();
    switches = PIND;
    inputs.left_switch = !(switches & LEFT_SWITCH);
    inputs.right_switch = !(switches & RIGHT_SWITCH);
    if (rig_tick(&robot, &inputs, &pwm)) {
        drive(pwm);
        send(frame, rig_report(&robot, frame));
    } else {
        drive(pwm);
    }
    if (robot.device.mode == CARTPOLE_ARMED)
        PORTB |= LED_ARMED;
    else
        PORTB &= (uint8_t)~LED_ARMED;
    if (robot.phase == RIG_POLE)
        PORTB |= LED_SET_POLE;
    else
        PORTB &= (uint8_t)~LED_SET_POLE;
    wdt_reset();
}

int main(void)
{
    uint8_t frame[CARTPOLE_MAX_FRAME];
    rig_settings settings;
    load(&settings);
    rig_init(&robot, &settings);
    set_up();
    for (;;) {
        if (ticks_due) {
            GPIOR0 = 1; /* A simulator counts the cycles until it is 0. */
            tick();
            GPIOR0 = 0;
        } else if (rx_in != rx_out) {
            uint8_t byte = rx[rx_out];
            rx_out = (uint8_t)((rx_out + 1) & (RX_SIZE - 1));
            send(frame, rig_receive(&robot, byte, frame));
        } else {
            cli();
            if (!ticks_due && rx_in == rx_out) {
                sleep_enable();
                sei(); /* The next instruction runs before any interrupt, so no interrupt is missed by sleeping. */
                sleep_cpu();
                sleep_disable();
            }
            sei();
        }
    }
}

/* After a reset by the watchdog, the watchdog still runs, with its shortest time. */
void no_watchdog(void) __attribute__((naked, used, section(".init3")));
void no_watchdog(void)
{
    MCUSR = 0;
    wdt_disable();
}
