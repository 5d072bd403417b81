/* A pole encoder node beside a motor drive, on the board of main.c; pins: docs/how-to/cartpole-odrive.md.
 *
 * It samples when the drive's estimates come, so that cart and pole are of one moment.
 */
#include "board.h"

#define NODE 2
#define WINDOW 21 /* Ticks that are kept: velocities are differences over 20 to 21 ms. */

static uint16_t counts_before[WINDOW];
static uint8_t oldest;

static void tick(void)
{
    rig_inputs inputs = {0, (int16_t)TIM_CNT(TIM4), !(GPIO_IDR(GPIOB) >> LEFT_SWITCH & 1), false, false};
    int16_t pwm;
    rig_tick(&robot, &inputs, &pwm);
    counts_before[oldest] = (uint16_t)inputs.pole_counts;
    oldest = (uint8_t)((oldest + 1) % WINDOW);
    set_pin(GPIOC, LED_SET_POLE, robot.phase != RIG_POLE);
    IWDG_KR = IWDG_RELOAD;
}

static void sample(void)
{
    cartpole_can_frame frames[CARTPOLE_CAN_REPORT];
    cartpole_reading reading = {0, 0, 0, 0, 0, false, false, 0};
    uint32_t left = SYST_CVR;
    uint16_t counts;
    /* A new millisecond may begin at any moment: without its tick, the time would be 1 ms early. */
    if (SYST_CSR & SYST_COUNTFLAG) {
        tick();
        left = SYST_CVR;
    }
    counts = (uint16_t)TIM_CNT(TIM4);
    reading.late_us = (uint16_t)((CORE_HZ / CARTPOLE_CONTROL_HZ - 1 - left) / (CORE_HZ / 1000000UL));
    reading.pole_urad = rig_pole_urad(robot.pole_counts + (int16_t)(counts - (uint16_t)robot.last_pole));
    reading.pole_urad_s = (int32_t)(rig_pole_urad((int16_t)(counts - counts_before[oldest])) * 1000000LL /
                                    ((WINDOW - 1) * 1000 + reading.late_us));
    send_can(frames, cartpole_can_report(&robot.device, &can, &reading, frames));
}

/* One turn of the main loop. */
static void step(void)
{
    if (SYST_CSR & SYST_COUNTFLAG)
        tick();
    if (serve_can())
        sample();
}

static void set_up(void)
{
    stored_settings settings = set_up_board(NODE);
    robot.device.encoder = true;
    set_up_can(&settings);
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
