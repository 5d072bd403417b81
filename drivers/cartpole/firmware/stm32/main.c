/* The cart-pole's firmware on an STM32F103C8 with a crystal of 8 MHz ("Blue Pill"). Pins: docs/how-to/firmware.md.
 *
 * The jumper BOOT1 chooses the wire at power-on: 0 serial, 1 CAN. Everything is polled but the UART's receiver.
 */
#include "board.h"

#define PWM_PRESCALER 4UL /* 72 MHz / 4 / 800 = 22.5 kHz. */

#define RX_SIZE 256 /* Powers of two. */
#define TX_SIZE 256

static volatile uint8_t rx[RX_SIZE], rx_in;
static volatile uint8_t rx_out;
static uint8_t tx[TX_SIZE], tx_in, tx_out;
static bool on_can;

void usart1_interrupt(void)
{
    uint8_t byte, next = (uint8_t)(rx_in + 1);
    if (!(USART1_SR & RXNE))
        return;
    byte = (uint8_t)USART1_DR;
    rx[rx_in] = byte;
    if (next != rx_out)
        rx_in = next;
}

/* Queue a frame, or drop it if it does not fit: half a frame would also corrupt the next one. */
static void send(const uint8_t *frame, uint8_t length)
{
    if (length > (uint8_t)(tx_out - tx_in - 1))
        return;
    for (; length; length--)
        tx[tx_in++] = *frame++;
}

static void serve_serial(void)
{
    uint8_t frame[CARTPOLE_MAX_FRAME];
    if (rx_out != rx_in)
        send(frame, rig_receive(&robot, rx[rx_out++], frame));
    if (tx_out != tx_in && (USART1_SR & TXE))
        USART1_DR = tx[tx_out++];
}

static void report(void)
{
    if (on_can) {
        cartpole_can_frame frames[CARTPOLE_CAN_REPORT];
        cartpole_reading reading = rig_read(&robot);
        send_can(frames, cartpole_can_report(&robot.device, &can, &reading, frames));
    } else {
        uint8_t frame[CARTPOLE_MAX_FRAME];
        send(frame, rig_report(&robot, frame));
    }
}

static void tick(void)
{
    uint32_t pins = GPIO_IDR(GPIOB);
    rig_inputs inputs;
    int16_t pwm;
    bool due;
    inputs.cart_counts = (int16_t)TIM_CNT(TIM2);
    inputs.pole_counts = (int16_t)TIM_CNT(TIM4);
    inputs.left_switch = !(pins >> LEFT_SWITCH & 1);
    inputs.right_switch = !(pins >> RIGHT_SWITCH & 1);
    inputs.lost_counts = false; /* These timers do not tell. */
    due = rig_tick(&robot, &inputs, &pwm);
    set_pin(GPIOA, MOTOR_REVERSE, pwm < 0);
    TIM_CCR1(TIM3) = (uint32_t)(pwm < 0 ? -pwm : pwm);
    if (due)
        report();
    set_pin(GPIOB, LED_ARMED, robot.device.mode == CARTPOLE_ARMED);
    set_pin(GPIOC, LED_SET_POLE, robot.phase != RIG_POLE);
    IWDG_KR = IWDG_RELOAD;
}

/* One turn of the main loop. */
static void step(void)
{
    if (SYST_CSR & SYST_COUNTFLAG)
        tick();
    if (on_can)
        serve_can();
    else
        serve_serial();
}

static void set_up_serial(void)
{
    set_mode(GPIOA, 9, PIN_PERIPHERAL);
    pull_up(GPIOA, 10);
    USART1_BRR = CORE_HZ / 1000000UL;
    USART1_CR1 = UE | TE | RE | RXNEIE;
    NVIC_ISER1 = 1UL << (USART1_IRQ - 32);
}

static void set_up(void)
{
    stored_settings settings = set_up_board(CARTPOLE_CAN_NODE);
    pull_up(GPIOA, 15);
    pull_up(GPIOB, 3);
    pull_up(GPIOB, RIGHT_SWITCH);
    set_up_encoder(TIM2);
    TIM_PSC(TIM3) = PWM_PRESCALER - 1;
    TIM_ARR(TIM3) = RIG_PWM_TOP;
    TIM_CCMR1(TIM3) = PWM_MODE_1_PRELOADED;
    TIM_CCER(TIM3) = CC1E;
    TIM_EGR(TIM3) = UG;
    TIM_CR1(TIM3) = ARPE | CEN;
    set_mode(GPIOA, MOTOR_REVERSE, PIN_OUTPUT);
    set_mode(GPIOA, 6, PIN_PERIPHERAL);
    set_mode(GPIOB, LED_ARMED, PIN_OUTPUT);
    on_can = GPIO_IDR(GPIOB) >> BOOT1 & 1;
    if (on_can)
        set_up_can(&settings);
    else
        set_up_serial();
    start_ticks();
}

#ifndef HOST
int main(void)
{
    set_up();
    for (;;)
        step();
}
#endif
