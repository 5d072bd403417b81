/* The part of a port beside the wire: encoder counts to positions, homing against a switch, end stops, the motor.
 *
 * A port calls rig_receive() for each byte. Every millisecond it calls rig_tick(), and, if that returns true,
 * rig_report(). On CAN it gives rig.device and rig.motor to cartpole_can_receive(), and rig_read() to
 * cartpole_can_report().
 */
#ifndef RIG_H
#define RIG_H

#include "cartpole.h"

#define RIG_NM_PER_COUNT 25000L       /* 1600 counts a turn on a belt pulley of 40 mm a turn. */
#define RIG_COUNTS_PER_TURN 4096L     /* The pole's encoder. */
#define RIG_URAD_PER_COUNT_Q20 1608495439L /* 2 pi / 4096 rad, in urad times 2^20. */
#define RIG_SWITCH_UM 395000L         /* Where the switches at both ends close. */
#define RIG_VELOCITY_TICKS 2          /* The position loop differences the cart over 2 ms: 12.5 mm/s a count, */
#define RIG_VELOCITY_REPORTS 4        /* state frames difference over 20 ms. */
#define RIG_PWM_TOP 799L              /* Motor fully on. */

/* Homing: speed and force of the cart, tolerances of the middle and of upright. */
#define RIG_HOMING_UM_S 250000UL
#define RIG_HOMING_MN 3000U
#define RIG_HOMING_MN_M 80000UL
#define RIG_HOMING_MNS_M 8000UL
#define RIG_HOMING_TICKS 15000U       /* Longest way to switch and middle. */
#define RIG_MIDDLE_NM 2000000L
#define RIG_UPRIGHT_COUNTS 65         /* 0.1 rad. */
#define RIG_STILL_TICKS 300U

enum rig_phase { RIG_REST, RIG_SEEK, RIG_CENTRE, RIG_POLE };

typedef struct {
    int16_t cart_counts, pole_counts; /* Since power-on, modulo 2^16. */
    bool left_switch, right_switch;
    bool lost_counts;                 /* An encoder moved two steps at once. */
} rig_inputs;

typedef struct {
    cartpole_settings device;
    uint16_t full_force_mn;           /* Force on the cart with the PWM fully on. */
} rig_settings;

typedef struct {
    cartpole device;
    cartpole_motor motor;
    cartpole_servo homing;
    int32_t cart_counts, pole_counts;         /* From the middle, from upright. */
    int32_t cart_before[RIG_VELOCITY_TICKS];
    int32_t cart_um_before[RIG_VELOCITY_REPORTS], pole_urad_before[RIG_VELOCITY_REPORTS];
    int32_t pwm_step, pwm_rest;               /* 2^20 pN a step of the PWM; what the last step left over. */
    uint32_t homings;
    uint16_t phase_ticks;
    int16_t last_cart, last_pole;
    uint8_t at, report_at, phase;
    bool fault, left, right;
} rig;

int32_t rig_pole_urad(int32_t counts);
/* Set device.encoder after this where there is no motor: homing then ends while the left switch, a button, is held and
 * the pole is upright. */
void rig_init(rig *rig, const rig_settings *settings);
uint8_t rig_receive(rig *rig, uint8_t byte, uint8_t *frame);
/* Run one tick; return whether a state frame is due. The PWM is from -RIG_PWM_TOP to RIG_PWM_TOP. */
bool rig_tick(rig *rig, const rig_inputs *inputs, int16_t *pwm);
/* Return what the state of the tick that ran last reports; call it once for each state. */
cartpole_reading rig_read(rig *rig);
uint8_t rig_report(rig *rig, uint8_t *frame);

#endif
