#include "cartpole.h"

#define TICKS_PER_STATE (CARTPOLE_CONTROL_HZ / CARTPOLE_STATE_HZ)
#define MOST_AGE_TICKS 4294968UL /* A larger age in us exceeds its field. */

uint8_t *cartpole_put(uint8_t *at, uint32_t value, uint8_t bytes)
{
    for (; bytes; bytes--, value >>= 8)
        *at++ = (uint8_t)value;
    return at;
}

static uint32_t get(const uint8_t *at)
{
    return (uint32_t)at[0] | (uint32_t)at[1] << 8 | (uint32_t)at[2] << 16 | (uint32_t)at[3] << 24;
}

void cartpole_init(cartpole *device, const cartpole_settings *settings)
{
    uint8_t *bytes = (uint8_t *)device;
    uint16_t i;
    for (i = 0; i < sizeof *device; i++)
        bytes[i] = 0;
    device->settings = *settings;
    device->command_sequence = CARTPOLE_NO_COMMAND;
    device->mode = CARTPOLE_IDLE;
    cartpole_servo_reset(&device->servo, 0);
}

void cartpole_stop(cartpole *device)
{
    device->queue_count = 0;
    cartpole_servo_reset(&device->servo, device->servo.setpoint_nm);
    device->mode = CARTPOLE_IDLE;
}

void cartpole_finish_homing(cartpole *device)
{
    if (device->mode == CARTPOLE_HOMING) {
        device->mode = CARTPOLE_IDLE;
        device->homed = true;
    }
}

static void take_target(cartpole *device, const uint8_t *body)
{
    uint32_t sequence = get(body), due_tick = device->tick;
    cartpole_target *target;
    /* A repeated number comes from a stuck host or adapter; it must not reset the watchdog. */
    if (device->mode != CARTPOLE_ARMED || sequence == device->command_sequence)
        return;
    device->command_sequence = sequence;
    device->command_age = 0;
    device->silence = 0;
    due_tick += device->draw_delay ? device->draw_delay() : device->settings.delay_ticks;
    if (device->queue_count > 0) {
        uint32_t last = device->queue[(device->queue_first + device->queue_count - 1) % CARTPOLE_QUEUE].due_tick;
        if ((int32_t)(due_tick - last) < 0)
            due_tick = last;
    }
    if (device->queue_count < CARTPOLE_QUEUE)
        device->queue_count++;
    target = &device->queue[(device->queue_first + device->queue_count - 1) % CARTPOLE_QUEUE];
    target->due_tick = due_tick;
    target->position_um = (int32_t)get(body + 4);
    target->stiffness_mn_m = get(body + 8);
    target->damping_mns_m = get(body + 12);
    target->effort_limit_mn = (uint16_t)(body[16] | (uint16_t)body[17] << 8);
    target->speed_limit_um_s = get(body + 18);
}

static uint8_t greet(cartpole *device, uint8_t request, uint8_t *answer)
{
    const char *kind = device->encoder ? "pole-encoder" : "cartpole";
    uint8_t i, *at = answer;
    cartpole_stop(device);
    device->command_sequence = CARTPOLE_NO_COMMAND;
    device->last_request = 0;
    *at++ = CARTPOLE_VERSION;
    *at++ = CARTPOLE_INFO;
    *at++ = request;
    for (i = 0; i < 16; i++)
        *at++ = *kind ? (uint8_t)*kind++ : 0;
    *at++ = CARTPOLE_FIRMWARE_MAJOR;
    *at++ = CARTPOLE_FIRMWARE_MINOR;
    *at++ = CARTPOLE_FIRMWARE_PATCH;
    at = cartpole_put(at, CARTPOLE_CONTROL_HZ, 2);
    at = cartpole_put(at, CARTPOLE_STATE_HZ, 2);
    at = cartpole_put(at, device->settings.unique_id, 4);
    at = cartpole_put(at, 0, 4);
    return (uint8_t)(at - answer);
}

static uint8_t act(cartpole *device, uint8_t type, const cartpole_motor *motor)
{
    if (type == CARTPOLE_STOP) {
        cartpole_stop(device);
    } else if (type == CARTPOLE_HOME) {
        cartpole_stop(device);
        device->homed = device->watchdog = false;
        device->mode = CARTPOLE_HOMING;
        device->homings++;
    } else {
        if (device->mode == CARTPOLE_HOMING)
            return CARTPOLE_STILL_HOMING;
        if (!device->homed || device->encoder)
            return CARTPOLE_NOT_HOMED;
        device->watchdog = false;
        if (device->mode != CARTPOLE_ARMED) {
            cartpole_servo_reset(&device->servo, motor->position_nm);
            device->mode = CARTPOLE_ARMED;
            device->armings++;
        }
        device->silence = 0;
    }
    return CARTPOLE_DONE;
}

uint8_t cartpole_handle(cartpole *device, const uint8_t *payload, uint8_t length, const cartpole_motor *motor,
                        uint8_t *answer)
{
    uint8_t type = length < 2 ? 0 : payload[1], result = CARTPOLE_DONE;
    uint16_t key;
    if (type == CARTPOLE_HELLO && length == 3)
        return greet(device, payload[2], answer);
    if (type >= CARTPOLE_ARM && type <= CARTPOLE_HOME && length == 3 && payload[0] == CARTPOLE_VERSION) {
        /* A host that missed the answer repeats the request with the same number; it must not act twice. */
        key = (uint16_t)((uint16_t)type << 8 | payload[2]);
        if (key != device->last_request) {
            result = act(device, type, motor);
            device->last_request = result == CARTPOLE_DONE ? key : 0;
        }
        cartpole_put(answer, CARTPOLE_VERSION | (uint32_t)CARTPOLE_ACK << 8 | (uint32_t)payload[2] << 16 |
                        (uint32_t)type << 24, 4);
        answer[4] = result;
        return 5;
    }
    if (type == CARTPOLE_TARGET && length == 24 && payload[0] == CARTPOLE_VERSION)
        take_target(device, payload + 2);
    else
        device->decoder.errors++;
    return 0;
}

uint8_t cartpole_receive(cartpole *device, uint8_t byte, const cartpole_motor *motor, uint8_t *frame)
{
    uint8_t answer[CARTPOLE_MAX_PAYLOAD];
    uint8_t length = cartpole_decode(&device->decoder, byte);
    if (length > 0)
        length = cartpole_handle(device, device->decoder.block, length, motor, answer);
    return length > 0 ? cartpole_frame(answer, length, frame) : 0;
}

bool cartpole_control(cartpole *device, const cartpole_motor *motor, int64_t *force_pn)
{
    bool due = device->until_state == 0;
    *force_pn = 0;
    if (device->mode == CARTPOLE_ARMED && device->silence >= CARTPOLE_WATCHDOG_TICKS) {
        cartpole_stop(device);
        device->watchdog = true;
    }
    if (device->mode == CARTPOLE_ARMED) {
        while (device->queue_count > 0) {
            cartpole_target *target = &device->queue[device->queue_first];
            if ((int32_t)(target->due_tick - device->tick) > 0)
                break;
            cartpole_servo_accept(&device->servo, target, &device->settings);
            device->queue_first = (uint16_t)((device->queue_first + 1) % CARTPOLE_QUEUE);
            device->queue_count--;
        }
        *force_pn = cartpole_servo_update(&device->servo, motor);
    }
    device->tick++;
    device->device_us += 1000000UL / CARTPOLE_CONTROL_HZ;
    if (device->silence < CARTPOLE_WATCHDOG_TICKS)
        device->silence++;
    if (device->command_age <= MOST_AGE_TICKS)
        device->command_age++;
    device->until_state = due ? TICKS_PER_STATE - 1 : device->until_state - 1;
    return due;
}

uint8_t cartpole_state(cartpole *device, const cartpole_reading *reading, uint8_t *payload)
{
    uint8_t status = 0, *at = payload;
    uint64_t device_us = device->device_us - 1000000UL / CARTPOLE_CONTROL_HZ + reading->late_us;
    uint32_t age = device->command_age - 1; /* The reported tick has already incremented it. */
    bool clamped;
    int16_t effort_mn = cartpole_servo_estimate(&device->servo, reading, &clamped);
    if (device->mode == CARTPOLE_ARMED) {
        status = CARTPOLE_STATUS_ARMED;
        if (clamped)
            status |= CARTPOLE_STATUS_EFFORT;
        if (device->servo.setpoint_nm != device->servo.target_nm)
            status |= CARTPOLE_STATUS_SPEED;
    } else {
        effort_mn = 0;
    }
    if (device->homed)
        status |= CARTPOLE_STATUS_HOMED;
    if (device->mode == CARTPOLE_HOMING)
        status |= CARTPOLE_STATUS_HOMING;
    if (device->watchdog)
        status |= CARTPOLE_STATUS_WATCHDOG;
    if (reading->at_end_stop)
        status |= CARTPOLE_STATUS_END_STOP;
    if (reading->fault)
        status |= CARTPOLE_STATUS_FAULT;
    *at++ = CARTPOLE_VERSION;
    *at++ = CARTPOLE_STATE;
    at = cartpole_put(at, device->state_count++, 4);
    at = cartpole_put(at, (uint32_t)device_us, 4);
    at = cartpole_put(at, (uint32_t)(device_us >> 32), 4);
    at = cartpole_put(at, (uint32_t)reading->cart_um, 4);
    at = cartpole_put(at, (uint32_t)reading->cart_um_s, 4);
    at = cartpole_put(at, (uint32_t)reading->pole_urad, 4);
    at = cartpole_put(at, (uint32_t)reading->pole_urad_s, 4);
    at = cartpole_put(at, (uint16_t)effort_mn, 2);
    *at++ = status;
    at = cartpole_put(at, device->command_sequence, 4);
    if (device->command_sequence == CARTPOLE_NO_COMMAND)
        age = 0;
    else
        age = age >= MOST_AGE_TICKS ? 0xFFFFFFFFUL : age * 1000;
    at = cartpole_put(at, age, 4);
    return (uint8_t)(at - payload);
}

uint8_t cartpole_report(cartpole *device, const cartpole_reading *reading, uint8_t *frame)
{
    uint8_t payload[CARTPOLE_STATE_PAYLOAD];
    return cartpole_frame(payload, cartpole_state(device, reading, payload), frame);
}
