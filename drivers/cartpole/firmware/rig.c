#include "rig.h"

static int32_t magnitude(int32_t value)
{
    return value < 0 ? -value : value;
}

int32_t rig_pole_urad(int32_t counts)
{
    return (int32_t)((counts * (int64_t)RIG_URAD_PER_COUNT_Q20) >> 20);
}

static void remember_pole(rig *rig)
{
    uint8_t i;
    for (i = 0; i < RIG_VELOCITY_REPORTS; i++)
        rig->pole_urad_before[i] = rig_pole_urad(rig->pole_counts);
}

void rig_init(rig *rig, const rig_settings *settings)
{
    uint8_t *bytes = (uint8_t *)rig;
    uint16_t i;
    for (i = 0; i < sizeof *rig; i++)
        bytes[i] = 0;
    cartpole_init(&rig->device, &settings->device);
    rig->pwm_step = (int32_t)(((uint64_t)settings->full_force_mn * 1000000000ULL / RIG_PWM_TOP) >> 20);
    if (rig->pwm_step == 0)
        rig->pwm_step = 1;
    rig->pole_counts = RIG_COUNTS_PER_TURN / 2; /* At power-on the pole hangs. */
    remember_pole(rig);
}

uint8_t rig_receive(rig *rig, uint8_t byte, uint8_t *frame)
{
    return cartpole_receive(&rig->device, byte, &rig->motor, frame);
}

static void enter(rig *rig, uint8_t phase)
{
    rig->phase = phase;
    rig->phase_ticks = 0;
}

static void aim(rig *rig, int32_t target_um)
{
    cartpole_target target = {0, target_um, RIG_HOMING_MN_M, RIG_HOMING_MNS_M, RIG_HOMING_UM_S, RIG_HOMING_MN};
    cartpole_servo_accept(&rig->homing, &target, &rig->device.settings);
}

/* Move the zero of the cart, with all stored positions. */
static void shift(rig *rig, int32_t counts)
{
    uint8_t i;
    rig->cart_counts += counts;
    rig->motor.position_nm = rig->cart_counts * RIG_NM_PER_COUNT;
    for (i = 0; i < RIG_VELOCITY_TICKS; i++)
        rig->cart_before[i] += counts;
    for (i = 0; i < RIG_VELOCITY_REPORTS; i++)
        rig->cart_um_before[i] += (int32_t)(counts * (RIG_NM_PER_COUNT / 1000));
}

static void fail(rig *rig)
{
    rig->fault = true;
    cartpole_stop(&rig->device);
    rig->device.homed = false;
    enter(rig, RIG_REST);
}

/* Left until the switch closes, back to the middle, then wait until the pole is set upright by hand. */
static int64_t home(rig *rig)
{
    int32_t turned;
    if (rig->device.homings != rig->homings) {
        rig->homings = rig->device.homings;
        rig->fault = false;
        shift(rig, -rig->cart_counts); /* The middle is unknown: begin at 0, so that 0.9 m of travel fit. */
        cartpole_servo_reset(&rig->homing, 0);
        enter(rig, rig->device.encoder ? RIG_POLE : RIG_SEEK);
    }
    if (rig->device.mode != CARTPOLE_HOMING) {
        rig->phase = RIG_REST;
        return 0;
    }
    rig->phase_ticks++;
    switch (rig->phase) {
    case RIG_SEEK:
        if (rig->left) {
            shift(rig, -RIG_SWITCH_UM * 1000 / RIG_NM_PER_COUNT - rig->cart_counts);
            cartpole_servo_reset(&rig->homing, rig->motor.position_nm);
            aim(rig, 0);
            enter(rig, RIG_CENTRE);
            return 0;
        }
        if (rig->phase_ticks > RIG_HOMING_TICKS)
            fail(rig);
        aim(rig, -CARTPOLE_RAIL_UM);
        /* The accepted target ends at the rail's end; the way to the switch may be twice as long. */
        rig->homing.target_nm = -900000000L;
        return cartpole_servo_update(&rig->homing, &rig->motor);
    case RIG_CENTRE:
        if (magnitude(rig->motor.position_nm) < RIG_MIDDLE_NM && rig->motor.velocity_um_s == 0) {
            enter(rig, RIG_POLE);
            return 0;
        }
        if (rig->phase_ticks > RIG_HOMING_TICKS)
            fail(rig);
        /* Dry friction stops the cart before its target: move the target on until the cart arrives. */
        if (rig->homing.setpoint_nm == rig->homing.target_nm) {
            rig->homing.target_nm -= rig->motor.position_nm / 256;
            if (magnitude(rig->homing.target_nm) > 200000000L)
                rig->homing.target_nm = rig->homing.target_nm > 0 ? 200000000L : -200000000L;
        }
        return cartpole_servo_update(&rig->homing, &rig->motor);
    default:
        turned = rig->pole_counts & (RIG_COUNTS_PER_TURN - 1);
        if (turned >= RIG_COUNTS_PER_TURN / 2)
            turned -= RIG_COUNTS_PER_TURN;
        if (magnitude(turned) > RIG_UPRIGHT_COUNTS || (rig->device.encoder && !rig->left))
            rig->phase_ticks = 0;
        if (rig->phase_ticks >= RIG_STILL_TICKS) {
            rig->pole_counts = turned;
            remember_pole(rig);
            cartpole_finish_homing(&rig->device);
            enter(rig, RIG_REST);
        }
        return 0;
    }
}

bool rig_tick(rig *rig, const rig_inputs *inputs, int16_t *pwm)
{
    int64_t force_pn, homing_pn;
    int32_t wanted;
    bool due;
    rig->cart_counts += (int16_t)(inputs->cart_counts - rig->last_cart);
    rig->pole_counts += (int16_t)(inputs->pole_counts - rig->last_pole);
    rig->last_cart = inputs->cart_counts;
    rig->last_pole = inputs->pole_counts;
    rig->left = inputs->left_switch;
    rig->right = inputs->right_switch;
    rig->motor.position_nm = rig->cart_counts * RIG_NM_PER_COUNT;
    rig->motor.velocity_um_s = (rig->cart_counts - rig->cart_before[rig->at]) * (RIG_NM_PER_COUNT / 1000) *
                               (CARTPOLE_CONTROL_HZ / RIG_VELOCITY_TICKS);
    rig->cart_before[rig->at] = rig->cart_counts;
    rig->at = (uint8_t)((rig->at + 1) % RIG_VELOCITY_TICKS);
    /* Without a valid position the motor must not move. */
    if (inputs->lost_counts && (rig->device.homed || rig->device.mode == CARTPOLE_HOMING))
        fail(rig);
    due = cartpole_control(&rig->device, &rig->motor, &force_pn);
    homing_pn = home(rig);
    wanted = (int32_t)((rig->device.mode == CARTPOLE_HOMING ? homing_pn : force_pn) >> 20);
    if ((rig->left && wanted < 0) || (rig->right && wanted > 0))
        wanted = 0;
    if (wanted == 0) {
        rig->pwm_rest = 0;
        *pwm = 0;
        return due;
    }
    /* The rest of a PWM step is added to the next one. */
    wanted += rig->pwm_rest;
    *pwm = (int16_t)(magnitude(wanted) / rig->pwm_step > RIG_PWM_TOP ? RIG_PWM_TOP
                                                                     : magnitude(wanted) / rig->pwm_step);
    if (wanted < 0)
        *pwm = (int16_t)-*pwm;
    rig->pwm_rest = magnitude(*pwm) == RIG_PWM_TOP ? 0 : wanted - *pwm * rig->pwm_step;
    return due;
}

cartpole_reading rig_read(rig *rig)
{
    cartpole_reading reading;
    uint8_t at = rig->report_at;
    reading.cart_um = rig->cart_counts * (RIG_NM_PER_COUNT / 1000);
    reading.pole_urad = rig_pole_urad(rig->pole_counts);
    reading.cart_um_s = (reading.cart_um - rig->cart_um_before[at]) * (CARTPOLE_STATE_HZ / RIG_VELOCITY_REPORTS);
    reading.pole_urad_s = (reading.pole_urad - rig->pole_urad_before[at]) * (CARTPOLE_STATE_HZ / RIG_VELOCITY_REPORTS);
    rig->cart_um_before[at] = reading.cart_um;
    rig->pole_urad_before[at] = reading.pole_urad;
    rig->report_at = (uint8_t)((at + 1) % RIG_VELOCITY_REPORTS);
    reading.setpoint_nm = rig->device.servo.setpoint_nm;
    reading.at_end_stop = rig->left || rig->right;
    reading.fault = rig->fault;
    reading.late_us = 0;
    return reading;
}

uint8_t rig_report(rig *rig, uint8_t *frame)
{
    cartpole_reading reading = rig_read(rig);
    return cartpole_report(&rig->device, &reading, frame);
}
