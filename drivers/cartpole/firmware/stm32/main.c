/* The cart-pole's firmware on an STM32F103C8 with a crystal of 8 MHz ("Blue Pill"). Pins: docs/how-to/firmware.md.
 *
 * The jumper BOOT1 chooses the wire at power-on: 0 serial, 1 CAN. Everything is polled but the UART's receiver.
 */
#include "stm32f103.h"

#include "../rig.h"

#define CORE_HZ 72000000UL
#define APB1_KHZ 36000UL
#define PWM_PRESCALER 4UL /* 72 MHz / 4 / 800 = 22.5 kHz. */
#define CAN_QUANTA 18UL   /* A bit: 1, 15 before and 2 after the sample point. */

#define RX_SIZE 256 /* Powers of two. */
#define TX_SIZE 256
#define CAN_SIZE 32

#define MOTOR_REVERSE 5   /* PA */
#define BOOT1 2           /* PB */
#define LEFT_SWITCH 12
#define RIGHT_SWITCH 13
#define LED_ARMED 14
#define LED_SET_POLE 13   /* PC, on the board: low is on. */

/* The settings in the last page of the flash, CRC-16/IBM-3740 last; without them the nominal ones apply. */
typedef struct {
    uint32_t stiffness_trim, damping_trim, effort_trim, speed_trim, unique_id;
    uint16_t delay_ticks, full_force_mn, node, can_kbit, crc;
} stored_settings;

#ifdef HOST
static stored_settings stored;
#else
#define stored (*(const stored_settings *)0x0800FC00UL)
#endif

static volatile uint8_t rx[RX_SIZE], rx_in;
static volatile uint8_t rx_out;
static uint8_t tx[TX_SIZE], tx_in, tx_out;
static cartpole_can_frame queue[CAN_SIZE];
static uint8_t queue_in, queue_out;
static bool on_can, was_off;
static cartpole_can can;
static rig robot;

void usart1_interrupt(void);

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

static void count(uint16_t *counter)
{
    if (*counter < 0xFFFF)
        (*counter)++;
}

/* The same for a message's frames. */
static void send_can(const cartpole_can_frame *frames, uint8_t length)
{
    if (length > ((queue_out - queue_in - 1) & (CAN_SIZE - 1))) {
        count(&can.drops);
        return;
    }
    for (; length; length--) {
        queue[queue_in] = *frames++;
        queue_in = (queue_in + 1) & (CAN_SIZE - 1);
    }
}

static uint32_t word(const uint8_t *data)
{
    return data[0] | (uint32_t)data[1] << 8 | (uint32_t)data[2] << 16 | (uint32_t)data[3] << 24;
}

static void serve_can(void)
{
    cartpole_can_frame frame = {0, 0, {0}, {0}}, out[CARTPOLE_CAN_ANSWER];
    uint32_t mailbox, errors = CAN_ESR, i;
    can.transmit_errors = (uint8_t)(errors >> 16);
    can.receive_errors = (uint8_t)(errors >> 24);
    if ((errors & BOFF) && !was_off)
        count(&can.bus_offs);
    was_off = (errors & BOFF) != 0;
    if (CAN_RF0R & FOVR0) {
        count(&can.overflows);
        CAN_RF0R = FOVR0;
    }
    if (CAN_RF0R & FMP0) {
        uint32_t low = CAN_RDL0R, high = CAN_RDH0R;
        frame.id = CAN_RI0R >> 21; /* The filter passes no extended or remote frame. */
        frame.length = (uint8_t)(CAN_RDT0R & 15);
        for (i = 0; i < 4; i++) {
            frame.data[i] = (uint8_t)(low >> 8 * i);
            frame.data[4 + i] = (uint8_t)(high >> 8 * i);
        }
        CAN_RF0R = RFOM0;
        send_can(out, cartpole_can_receive(&robot.device, &can, &frame, &robot.motor, out));
    }
    for (mailbox = 0; mailbox < 3 && queue_out != queue_in; mailbox++) {
        if (!(CAN_TSR & TME(mailbox)))
            continue;
        frame = queue[queue_out];
        queue_out = (queue_out + 1) & (CAN_SIZE - 1);
        CAN_TDTR(mailbox) = frame.length;
        CAN_TDLR(mailbox) = word(frame.data);
        CAN_TDHR(mailbox) = word(frame.data + 4);
        CAN_TIR(mailbox) = frame.id << 21 | TXRQ;
    }
}

static void serve_serial(void)
{
    uint8_t frame[CARTPOLE_MAX_FRAME];
    if (rx_out != rx_in)
        send(frame, rig_receive(&robot, rx[rx_out++], frame));
    if (tx_out != tx_in && (USART1_SR & TXE))
        USART1_DR = tx[tx_out++];
}

static void set_pin(uint32_t port, uint32_t pin, bool high)
{
    GPIO_BSRR(port) = 1UL << (high ? pin : pin + 16);
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

/* Wait for a flag of the clocks; QEMU has none. */
static void wait_for(uint32_t flag)
{
#ifndef QEMU
    while (!(RCC_CR & flag))
        ;
#else
    (void)flag;
#endif
}

static void set_up_clock(void)
{
    RCC_CR |= HSEON;
    wait_for(HSERDY);
    FLASH_ACR = PRFTBE | LATENCY_2;
    RCC_CFGR = PLLSRC_HSE | PLLMUL_9 | PPRE1_HALF;
    RCC_CR |= PLLON;
    wait_for(PLLRDY);
    RCC_CFGR |= SW_PLL;
}

static void set_mode(uint32_t port, uint32_t pin, uint32_t mode)
{
    uint32_t shift = 4 * (pin & 7);
    if (pin < 8)
        GPIO_CRL(port) = (GPIO_CRL(port) & ~(15UL << shift)) | mode << shift;
    else
        GPIO_CRH(port) = (GPIO_CRH(port) & ~(15UL << shift)) | mode << shift;
}

static void pull_up(uint32_t port, uint32_t pin)
{
    set_pin(port, pin, true);
    set_mode(port, pin, PIN_PULLED_INPUT);
}

static void set_up_encoder(uint32_t timer)
{
    TIM_ARR(timer) = 0xFFFF;
    TIM_CCMR1(timer) = ENCODER_INPUTS;
    TIM_SMCR(timer) = SMS_BOTH_EDGES;
    TIM_CR1(timer) = CEN;
}

static void set_up_can(uint16_t node, uint16_t kbit)
{
    RCC_APB1ENR |= CANEN;
    AFIO_MAPR = SWJ_CFG_SWD_ONLY | TIM2_REMAP_PARTIAL_1 | CAN_REMAP_PB8_PB9;
    pull_up(GPIOB, 8);
    set_mode(GPIOB, 9, PIN_PERIPHERAL);
    cartpole_can_init(&can, (uint8_t)node);
    /* Frames leave in the order of their requests, and the controller returns from bus-off by itself. */
    CAN_MCR = INRQ | TXFP | ABOM;
    while (!(CAN_MSR & INAK))
        ;
    CAN_BTR = 1UL << 24 | 1UL << 20 | 14UL << 16 | (APB1_KHZ / CAN_QUANTA / kbit - 1);
    CAN_FMR |= FINIT;
    CAN_FA1R = 0;
    CAN_FM1R = 0;  /* Bank 0: an id under a mask, */
    CAN_FS1R = 1;  /* of 32 bits, */
    CAN_FFA1R = 0; /* for FIFO 0. */
    CAN_F0R1 = (uint32_t)can.node << 26;
    CAN_F0R2 = CARTPOLE_CAN_HOST_MASK << 21 | IDE_RTR;
    CAN_FA1R = 1;
    CAN_FMR &= ~FINIT;
    CAN_MCR = TXFP | ABOM;
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
    bool known = cartpole_crc((const uint8_t *)&stored, 28) == stored.crc;
    rig_settings settings = {{CARTPOLE_ONE, CARTPOLE_ONE, CARTPOLE_ONE, CARTPOLE_ONE, 0, 0}, 16000};
    uint16_t node = CARTPOLE_CAN_NODE, kbit = 500;
    if (known) {
        cartpole_settings device = {stored.stiffness_trim, stored.damping_trim, stored.effort_trim,
                                    stored.speed_trim, stored.unique_id, stored.delay_ticks};
        settings.device = device;
        settings.full_force_mn = stored.full_force_mn;
        node = stored.node;
        kbit = stored.can_kbit == 250 || stored.can_kbit == 1000 ? stored.can_kbit : 500;
    } else {
        settings.device.unique_id = UNIQUE_ID(0) ^ UNIQUE_ID(1) ^ UNIQUE_ID(2);
    }
    set_up_clock();
    rig_init(&robot, &settings);
    RCC_APB2ENR = AFIOEN | IOPAEN | IOPBEN | IOPCEN | USART1EN;
    RCC_APB1ENR = TIM2EN | TIM3EN | TIM4EN;
    AFIO_MAPR = SWJ_CFG_SWD_ONLY | TIM2_REMAP_PARTIAL_1;
    pull_up(GPIOA, 15);
    pull_up(GPIOB, 3);
    pull_up(GPIOB, 6);
    pull_up(GPIOB, 7);
    pull_up(GPIOB, LEFT_SWITCH);
    pull_up(GPIOB, RIGHT_SWITCH);
    set_up_encoder(TIM2);
    set_up_encoder(TIM4);
    TIM_PSC(TIM3) = PWM_PRESCALER - 1;
    TIM_ARR(TIM3) = RIG_PWM_TOP;
    TIM_CCMR1(TIM3) = PWM_MODE_1_PRELOADED;
    TIM_CCER(TIM3) = CC1E;
    TIM_EGR(TIM3) = UG;
    TIM_CR1(TIM3) = ARPE | CEN;
    set_mode(GPIOA, MOTOR_REVERSE, PIN_OUTPUT);
    set_mode(GPIOA, 6, PIN_PERIPHERAL);
    set_pin(GPIOC, LED_SET_POLE, true);
    set_mode(GPIOB, LED_ARMED, PIN_OUTPUT);
    set_mode(GPIOC, LED_SET_POLE, PIN_OUTPUT);
    on_can = GPIO_IDR(GPIOB) >> BOOT1 & 1;
    if (on_can)
        set_up_can(node, kbit);
    else
        set_up_serial();
    SYST_RVR = CORE_HZ / CARTPOLE_CONTROL_HZ - 1;
    SYST_CVR = 0;
    SYST_CSR = SYST_RUN;
    /* If the control loop hangs, the chip is reset: 150 periods of 40 kHz / 16 are 60 ms. */
    IWDG_KR = IWDG_START;
    IWDG_KR = IWDG_UNLOCK;
    IWDG_PR = 2;
    IWDG_RLR = 150;
    IWDG_KR = IWDG_RELOAD;
}

#ifndef HOST
int main(void)
{
    set_up();
    for (;;)
        step();
}
#endif
