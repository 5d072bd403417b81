/* Firmware of the cart-pole, the part that all chips share: C99, integers only, no heap, no library calls.
 *
 * Protocols: docs/reference/protocol-cartpole-serial.md and -can.md. Use: docs/how-to/firmware.md. Every millisecond a
 * port calls cartpole_receive() for each received byte, cartpole_control(), and, if that returns true,
 * cartpole_report(); on CAN cartpole_can_receive() for each frame, and cartpole_can_report(). All state is in one
 * struct a wire, so that a host may run several.
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
#define CARTPOLE_STATE_PAYLOAD 41

#define CARTPOLE_CAN_NODE 1                       /* Unless the settings name another, 1 to 62. */
#define CARTPOLE_CAN_NODES 62
#define CARTPOLE_CAN_HOST_MASK 0x7F8U             /* Ids from the host: (node << 5) under this mask. */
#define CARTPOLE_CAN_ANSWER 5                     /* Most frames of an answer, */
#define CARTPOLE_CAN_REPORT 7                     /* and of a state with heartbeat and errors. */
#define CARTPOLE_STATES_PER_HEARTBEAT 20

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
    uint16_t late_us; /* From the start of the tick to the reading. */
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

/* A classic CAN frame, as Linux' struct can_frame. */
typedef struct {
    uint32_t id;
    uint8_t length, padding[3], data[8];
} cartpole_can_frame;

/* A CAN wire. The counters and the controller's error counters are reported to the host; a port counts all but torn
 * and errors. */
typedef struct {
    uint8_t node, version;
    uint8_t parts; /* Frames of the target so far. */
    uint8_t target[26];
    uint32_t torn, errors; /* Messages that lost a frame; frames and messages that are corrupt or unknown. */
    uint16_t overflows, bus_offs, drops;
    uint8_t transmit_errors, receive_errors;
} cartpole_can;

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
    bool encoder; /* A pole encoder node on CAN, without a motor: never armed; its states are Angle frames. */
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
/* Write a number's lowest bytes, little-endian; return what comes after them. */
uint8_t *cartpole_put(uint8_t *at, uint32_t value, uint8_t bytes);
void cartpole_init(cartpole *device, const cartpole_settings *settings);
/* Execute a payload (version, type, body); return the length of the answer's payload, or 0. */
uint8_t cartpole_handle(cartpole *device, const uint8_t *payload, uint8_t length, const cartpole_motor *motor,
                        uint8_t *answer);
/* Take a byte from the host; return the length of the frame to answer with (at most CARTPOLE_MAX_FRAME), or 0. */
uint8_t cartpole_receive(cartpole *device, uint8_t byte, const cartpole_motor *motor, uint8_t *frame);
/* Run one tick; return whether a state frame is due in it. */
bool cartpole_control(cartpole *device, const cartpole_motor *motor, int64_t *force_pn);
/* Write the state's payload of the tick that ran last; return its length, CARTPOLE_STATE_PAYLOAD. */
uint8_t cartpole_state(cartpole *device, const cartpole_reading *reading, uint8_t *payload);
/* Write the same as a frame of the serial wire; return its length. */
uint8_t cartpole_report(cartpole *device, const cartpole_reading *reading, uint8_t *frame);
/* The cart is in the middle and the pole upright; nothing happens unless homing. */
void cartpole_finish_homing(cartpole *device);
/* Motor off, as by the host's stop. */
void cartpole_stop(cartpole *device);

/* can_frames.c: frames of the CAN wire. */
void cartpole_can_init(cartpole_can *can, uint8_t node);
/* Take a frame from the bus; return the number of frames to answer with, at most CARTPOLE_CAN_ANSWER. */
uint8_t cartpole_can_receive(cartpole *device, cartpole_can *can, const cartpole_can_frame *frame,
                             const cartpole_motor *motor, cartpole_can_frame *out);
/* Write the frames of the tick that ran last, at most CARTPOLE_CAN_REPORT; return their number. */
uint8_t cartpole_can_report(cartpole *device, const cartpole_can *can, const cartpole_reading *reading,
                            cartpole_can_frame *out);

#endif
