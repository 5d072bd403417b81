/* Firmware of the cart-pole, the part that all chips share: C99, integers only, no heap, no library calls.
 *
 * Protocol: docs/reference/protocol-cartpole-serial.md. Use: docs/how-to/firmware.md. Every millisecond a port calls
 * cartpole_receive() for each received byte, cartpole_control(), and, if that returns true, cartpole_report(). All
 * state is in one struct, so that a host may run several.
 */
#ifndef CARTPOLE_H
#define CARTPOLE_H

#include <stdbool.h>
#include <stdint.h>

#define CARTPOLE_VERSION 1
#define CARTPOLE_FIRMWARE_MAJOR 0
#define CARTPOLE_FIRMWARE_MINOR 1
#define CARTPOLE_FIRMWARE_PATCH 0
#define CARTPOLE_CONTROL_HZ 1000
#define CARTPOLE_STATE_HZ 200
#define CARTPOLE_WATCHDOG_TICKS 200
#define CARTPOLE_RAIL_UM 400000L
#define CARTPOLE_NO_COMMAND 0xFFFFFFFFUL
#define CARTPOLE_ONE 65536UL /* A trim of 1. */

#define CARTPOLE_MAX_BLOCK 64                     /* Longest COBS block, without its delimiter. */
#define CARTPOLE_MAX_FRAME (CARTPOLE_MAX_BLOCK + 1)
#define CARTPOLE_MAX_PAYLOAD (CARTPOLE_MAX_BLOCK - 3)

#ifndef CARTPOLE_QUEUE
#define CARTPOLE_QUEUE 8 /* Targets that wait for their tick; if the queue is full, the newest replaces the last. */
#endif

enum cartpole_mode { CARTPOLE_IDLE, CARTPOLE_HOMING, CARTPOLE_ARMED };

enum cartpole_message {
    CARTPOLE_HELLO = 0x01,
    CARTPOLE_ARM = 0x02,
    CARTPOLE_STOP = 0x03,
    CARTPOLE_HOME = 0x04,
    CARTPOLE_TARGET = 0x10,
    CARTPOLE_INFO = 0x81,
    CARTPOLE_ACK = 0x82,
    CARTPOLE_STATE = 0x90
};

enum cartpole_result { CARTPOLE_DONE, CARTPOLE_NOT_HOMED, CARTPOLE_STILL_HOMING };

enum cartpole_status {
    CARTPOLE_STATUS_ARMED = 1,
    CARTPOLE_STATUS_HOMED = 2,
    CARTPOLE_STATUS_HOMING = 4,
    CARTPOLE_STATUS_WATCHDOG = 8,
    CARTPOLE_STATUS_EFFORT = 16,
    CARTPOLE_STATUS_SPEED = 32,
    CARTPOLE_STATUS_END_STOP = 64,
    CARTPOLE_STATUS_FAULT = 128
};

/* Settings of one cart-pole, in EEPROM. Trims are factors times CARTPOLE_ONE, from commanded gains to the motor's
 * input that realises them. A delay makes the device late, for tests. */
typedef struct {
    uint32_t stiffness_trim, damping_trim, effort_trim, speed_trim;
    uint32_t unique_id;
    uint16_t delay_ticks;
} cartpole_settings;

/* Reading of the motor's own encoder. */
typedef struct {
    int32_t position_nm;
    int32_t velocity_um_s;
} cartpole_motor;

/* Values of a state frame, the set-point of that moment, and present faults. */
typedef struct {
    int32_t cart_um, cart_um_s, pole_urad, pole_urad_s;
    int32_t setpoint_nm;
    bool at_end_stop, fault;
} cartpole_reading;

typedef struct {
    int32_t stiffness_mn_m; /* K */
    int32_t damping_un_s_m; /* 1000 D, so that K * nm and D * um/s are both pN. */
    int64_t limit_pn;
} cartpole_gains;

typedef struct {
    int32_t setpoint_nm, target_nm, step_nm; /* The step is one tick's. */
    cartpole_gains sent, real;               /* As commanded, and with the trims. */
} cartpole_servo;

typedef struct {
    uint32_t due_tick;
    int32_t position_um;
    uint32_t stiffness_mn_m, damping_mns_m, speed_limit_um_s;
    uint16_t effort_limit_mn;
} cartpole_target;

typedef struct {
    uint8_t block[CARTPOLE_MAX_BLOCK];
    uint8_t length; /* CARTPOLE_MAX_BLOCK + 1: too long, invalid up to the next delimiter. */
    bool synchronised;
    uint32_t errors;
} cartpole_decoder;

typedef struct {
    cartpole_settings settings;
    uint16_t (*draw_delay)(void); /* Replaces the settings' delay if it is not null. */
    cartpole_decoder decoder;
    cartpole_servo servo;
    cartpole_target queue[CARTPOLE_QUEUE];
    uint16_t queue_first, queue_count;
    uint64_t device_us;
    uint32_t tick, state_count, command_sequence, command_age; /* The age counts ticks and stops at its end. */
    uint32_t homings, armings;
    uint16_t silence; /* Ticks since a target was accepted, or since arming. */
    uint16_t last_request; /* Type and number; 0: none. */
    uint8_t mode;
    uint8_t until_state;
    bool homed, watchdog;
} cartpole;

/* frames.c: bytes of the serial wire. */
uint16_t cartpole_crc(const uint8_t *data, uint8_t length);
/* Add the CRC to a payload of at most CARTPOLE_MAX_PAYLOAD bytes, and write the frame with its delimiter. */
uint8_t cartpole_frame(const uint8_t *payload, uint8_t length, uint8_t *frame);
/* Take a byte; return the length of the payload that it completed, which then starts at decoder->block, or 0. */
uint8_t cartpole_decode(cartpole_decoder *decoder, uint8_t byte);

/* servo.c: the position loop. */
void cartpole_servo_reset(cartpole_servo *servo, int32_t position_nm);
void cartpole_servo_accept(cartpole_servo *servo, const cartpole_target *target, const cartpole_settings *settings);
int64_t cartpole_servo_update(cartpole_servo *servo, const cartpole_motor *motor); /* Force on the cart [pN]. */
/* The demand that the command's own gains give for a reading, in mN; whether the effort limit cut it. */
int16_t cartpole_servo_estimate(const cartpole_servo *servo, const cartpole_reading *reading, bool *clamped);
int32_t cartpole_millinewton(int64_t force_pn);

/* cartpole.c: messages, modes, watchdog. */
void cartpole_init(cartpole *device, const cartpole_settings *settings);
/* Execute a payload (version, type, body); return the length of the answer's payload, or 0. */
uint8_t cartpole_handle(cartpole *device, const uint8_t *payload, uint8_t length, const cartpole_motor *motor,
                        uint8_t *answer);
/* Take a byte from the host; return the length of the frame to answer with (at most CARTPOLE_MAX_FRAME), or 0. */
uint8_t cartpole_receive(cartpole *device, uint8_t byte, const cartpole_motor *motor, uint8_t *frame);
/* Run one tick; return whether a state frame is due in it. */
bool cartpole_control(cartpole *device, const cartpole_motor *motor, int64_t *force_pn);
/* Write the state frame of the tick that ran last; return its length. */
uint8_t cartpole_report(cartpole *device, const cartpole_reading *reading, uint8_t *frame);
/* The cart is in the middle and the pole upright; nothing happens unless homing. */
void cartpole_finish_homing(cartpole *device);
/* Motor off, as by the host's stop. */
void cartpole_stop(cartpole *device);

#endif
