#include "cartpole.h"

#define MOST_NM 1000000000L    /* 1 m: positions beyond are cut, so that no sum leaves 32 bits. */
#define MOST_UM_S 33554431L    /* 34 m/s, so that D times v stays below 2^56. */
#define MOST_GAIN 0x7FFFFFFFUL /* 2.1 MN/m and 2.1 kN s/m. */
#define MOST_STEP_NM 500000000UL

static int32_t within(int32_t value, int32_t most)
{
    return value > most ? most : value < -most ? -most : value;
}

static uint32_t trimmed(uint32_t value, uint32_t trim, uint32_t most)
{
    uint64_t product = ((uint64_t)value * trim + CARTPOLE_ONE / 2) >> 16;
    return product > most ? most : (uint32_t)product;
}

static void set_gains(cartpole_gains *gains, uint32_t stiffness_mn_m, uint32_t damping_mns_m, uint32_t limit_un)
{
    gains->stiffness_mn_m = (int32_t)(stiffness_mn_m > MOST_GAIN ? MOST_GAIN : stiffness_mn_m);
    gains->damping_un_s_m = (int32_t)(damping_mns_m > MOST_GAIN / 1000 ? MOST_GAIN : damping_mns_m * 1000);
    gains->limit_pn = (int64_t)limit_un * 1000000L;
}

/* K e - D v in pN, exactly: below 2^31 * 2^31 + 2^31 * 2^25. */
static int64_t demand(const cartpole_gains *gains, int32_t error_nm, int32_t velocity_um_s)
{
    return (int64_t)gains->stiffness_mn_m * error_nm -
           (int64_t)gains->damping_un_s_m * within(velocity_um_s, MOST_UM_S);
}

void cartpole_servo_reset(cartpole_servo *servo, int32_t position_nm)
{
    servo->setpoint_nm = servo->target_nm = within(position_nm, MOST_NM);
    servo->step_nm = 0;
    set_gains(&servo->sent, 0, 0, 0);
    servo->real = servo->sent;
}

void cartpole_servo_accept(cartpole_servo *servo, const cartpole_target *target, const cartpole_settings *settings)
{
    uint32_t limit_un = (uint32_t)target->effort_limit_mn * 1000;
    servo->target_nm = within(target->position_um, CARTPOLE_RAIL_UM) * 1000;
    /* um/s times 1 ms are nm. */
    servo->step_nm = (int32_t)trimmed(target->speed_limit_um_s, settings->speed_trim, MOST_STEP_NM);
    set_gains(&servo->sent, target->stiffness_mn_m, target->damping_mns_m, limit_un);
    set_gains(&servo->real, trimmed(target->stiffness_mn_m, settings->stiffness_trim, MOST_GAIN),
              trimmed(target->damping_mns_m, settings->damping_trim, MOST_GAIN),
              trimmed(limit_un, settings->effort_trim, 0xFFFFFFFFUL));
}

int64_t cartpole_servo_update(cartpole_servo *servo, const cartpole_motor *motor)
{
    int32_t error_nm = servo->target_nm - servo->setpoint_nm;
    int64_t force_pn;
    if (error_nm > servo->step_nm)
        servo->setpoint_nm += servo->step_nm;
    else if (error_nm < -servo->step_nm)
        servo->setpoint_nm -= servo->step_nm;
    else
        servo->setpoint_nm = servo->target_nm;
    force_pn = demand(&servo->real, servo->setpoint_nm - within(motor->position_nm, MOST_NM), motor->velocity_um_s);
    if (force_pn > servo->real.limit_pn)
        return servo->real.limit_pn;
    return force_pn < -servo->real.limit_pn ? -servo->real.limit_pn : force_pn;
}

/* pN to mN by a product and shifts: a 64-bit division would take an AVR longer than the rest of the step. */
int32_t cartpole_millinewton(int64_t force_pn)
{
    int64_t micro = (force_pn + (1L << 19)) >> 20; /* 2^20 pN, some uN. */
    int32_t cut = micro > 0x7FFFFFFFL ? 0x7FFFFFFFL : micro < -0x7FFFFFFFL ? -0x7FFFFFFFL : (int32_t)micro;
    return (int32_t)(((int64_t)cut * 4503600L + 0x80000000LL) >> 32); /* 2^52 / 10^9. */
}

int16_t cartpole_servo_estimate(const cartpole_servo *servo, const cartpole_reading *reading, bool *clamped)
{
    int32_t cart_nm = within(reading->cart_um, MOST_NM / 1000) * 1000;
    int64_t limit_pn = servo->sent.limit_pn;
    int64_t force_pn = demand(&servo->sent, within(reading->setpoint_nm, MOST_NM) - cart_nm, reading->cart_um_s);
    *clamped = limit_pn > 0 && (force_pn >= limit_pn || force_pn <= -limit_pn);
    if (force_pn > limit_pn)
        force_pn = limit_pn;
    else if (force_pn < -limit_pn)
        force_pn = -limit_pn;
    return (int16_t)within(cartpole_millinewton(force_pn), 32767);
}
