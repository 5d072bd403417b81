#include "board.h"

#include <stddef.h>

#define APB1_KHZ 36000UL
#define CAN_QUANTA 18UL   /* A bit: 1, 15 before and 2 after the sample point. */
#define CAN_SIZE 32       /* A power of two. */
#define ESTIMATES 9U      /* Number of an ODrive's frame Get_Encoder_Estimates: id = node << 5 | number. */

#ifdef HOST
stored_settings stored;
#endif

static cartpole_can_frame queue[CAN_SIZE];
static uint8_t queue_in, queue_out;
static uint32_t estimates_id;
static bool was_off;
cartpole_can can;
rig robot;

static void count(uint16_t *counter)
{
    if (*counter < 0xFFFF)
        (*counter)++;
}

void send_can(const cartpole_can_frame *frames, uint8_t length)
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

bool serve_can(void)
{
    cartpole_can_frame frame = {0, 0, {0}, {0}}, out[CARTPOLE_CAN_ANSWER];
    uint32_t mailbox, errors = CAN_ESR, i;
    bool estimated = false;
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
        frame.id = CAN_RI0R >> 21; /* The filters pass no extended or remote frame. */
        frame.length = (uint8_t)(CAN_RDT0R & 15);
        for (i = 0; i < 4; i++) {
            frame.data[i] = (uint8_t)(low >> 8 * i);
            frame.data[4 + i] = (uint8_t)(high >> 8 * i);
        }
        CAN_RF0R = RFOM0;
        estimated = robot.device.encoder && frame.id == estimates_id;
        if (!estimated)
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
    return estimated;
}

void set_pin(uint32_t port, uint32_t pin, bool high)
{
    GPIO_BSRR(port) = 1UL << (high ? pin : pin + 16);
}

void set_mode(uint32_t port, uint32_t pin, uint32_t mode)
{
    uint32_t shift = 4 * (pin & 7);
    if (pin < 8)
        GPIO_CRL(port) = (GPIO_CRL(port) & ~(15UL << shift)) | mode << shift;
    else
        GPIO_CRH(port) = (GPIO_CRH(port) & ~(15UL << shift)) | mode << shift;
}

void pull_up(uint32_t port, uint32_t pin)
{
    set_pin(port, pin, true);
    set_mode(port, pin, PIN_PULLED_INPUT);
}

void set_up_encoder(uint32_t timer)
{
    TIM_ARR(timer) = 0xFFFF;
    TIM_CCMR1(timer) = ENCODER_INPUTS;
    TIM_SMCR(timer) = SMS_BOTH_EDGES;
    TIM_CR1(timer) = CEN;
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

stored_settings set_up_board(uint16_t node)
{
    stored_settings s = {CARTPOLE_ONE, CARTPOLE_ONE, CARTPOLE_ONE, CARTPOLE_ONE, 0, 0, 16000, node, 500, 0, 0};
    rig_settings settings;
    if (cartpole_crc((const uint8_t *)&stored, offsetof(stored_settings, crc)) == stored.crc)
        s = stored;
    else
        s.unique_id = UNIQUE_ID(0) ^ UNIQUE_ID(1) ^ UNIQUE_ID(2);
    settings.device = (cartpole_settings){s.stiffness_trim, s.damping_trim, s.effort_trim,
                                          s.speed_trim, s.unique_id, s.delay_ticks};
    settings.full_force_mn = s.full_force_mn;
    set_up_clock();
    rig_init(&robot, &settings);
    RCC_APB2ENR = AFIOEN | IOPAEN | IOPBEN | IOPCEN | USART1EN;
    RCC_APB1ENR = TIM2EN | TIM3EN | TIM4EN;
    AFIO_MAPR = SWJ_CFG_SWD_ONLY | TIM2_REMAP_PARTIAL_1;
    pull_up(GPIOB, 6);
    pull_up(GPIOB, 7);
    pull_up(GPIOB, LEFT_SWITCH);
    set_up_encoder(TIM4);
    set_pin(GPIOC, LED_SET_POLE, true);
    set_mode(GPIOC, LED_SET_POLE, PIN_OUTPUT);
    return s;
}

void set_up_can(const stored_settings *settings)
{
    uint32_t kbit = settings->can_kbit == 250 || settings->can_kbit == 1000 ? settings->can_kbit : 500;
    RCC_APB1ENR |= CANEN;
    AFIO_MAPR = SWJ_CFG_SWD_ONLY | TIM2_REMAP_PARTIAL_1 | CAN_REMAP_PB8_PB9;
    pull_up(GPIOB, 8);
    set_mode(GPIOB, 9, PIN_PERIPHERAL);
    cartpole_can_init(&can, (uint8_t)settings->node);
    estimates_id = (uint32_t)settings->drive << 5 | ESTIMATES;
    /* Frames leave in the order of their requests, and the controller returns from bus-off by itself. */
    CAN_MCR = INRQ | TXFP | ABOM;
    while (!(CAN_MSR & INAK))
        ;
    CAN_BTR = 1UL << 24 | 1UL << 20 | 14UL << 16 | (APB1_KHZ / CAN_QUANTA / kbit - 1);
    CAN_FMR |= FINIT;
    CAN_FA1R = 0;
    CAN_FM1R = 0;  /* Banks 0 and 1: an id under a mask, */
    CAN_FS1R = 3;  /* of 32 bits, */
    CAN_FFA1R = 0; /* for FIFO 0. */
    CAN_FR1(0) = (uint32_t)can.node << 26;
    CAN_FR2(0) = CARTPOLE_CAN_HOST_MASK << 21 | IDE_RTR;
    CAN_FR1(1) = estimates_id << 21;
    CAN_FR2(1) = 0x7FFUL << 21 | IDE_RTR;
    CAN_FA1R = robot.device.encoder ? 3 : 1;
    CAN_FMR &= ~FINIT;
    CAN_MCR = TXFP | ABOM;
}

void start_ticks(void)
{
    SYST_RVR = CORE_HZ / CARTPOLE_CONTROL_HZ - 1;
    SYST_CVR = 0;
    SYST_CSR = SYST_RUN;
    /* 150 periods of 40 kHz / 16 are 60 ms. */
    IWDG_KR = IWDG_START;
    IWDG_KR = IWDG_UNLOCK;
    IWDG_PR = 2;
    IWDG_RLR = 150;
    IWDG_KR = IWDG_RELOAD;
}
