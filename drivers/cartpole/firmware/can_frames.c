#include "cartpole.h"

/* Numbers of the frames: id = node << 5 | number. */
enum {
    STOP = 0,
    TARGET_1 = 1,
    TARGET_2 = 2,
    TARGET_3 = 3,
    ARM = 4,
    HOME = 5,
    HELLO = 6,
    STATE_1 = 8,
    HEARTBEAT = 13,
    ACK = 14,
    ERRORS = 15,
    INFO_1 = 16,
    ANGLE_1 = 21
};

static uint8_t *copy(uint8_t *to, const uint8_t *from, uint8_t length)
{
    while (length--)
        *to++ = *from++;
    return to;
}

static void fill(const cartpole_can *can, uint8_t number, const uint8_t *data, uint8_t length, cartpole_can_frame *out)
{
    uint8_t i;
    out->id = (uint32_t)can->node << 5 | number;
    out->length = length;
    for (i = 0; i < 3; i++)
        out->padding[i] = 0;
    for (i = 0; i < 8; i++)
        out->data[i] = i < length ? data[i] : 0;
}

void cartpole_can_init(cartpole_can *can, uint8_t node)
{
    uint8_t i, *bytes = (uint8_t *)can;
    for (i = 0; i < sizeof *can; i++)
        bytes[i] = 0;
    can->node = node >= 1 && node <= CARTPOLE_CAN_NODES ? node : CARTPOLE_CAN_NODE;
    can->version = CARTPOLE_VERSION;
}

/* Add a frame of a target in its order; return whether the target is complete and its CRC right. */
static bool join(cartpole_can *can, uint8_t index, const uint8_t *data)
{
    uint8_t *block = can->target;
    if (index == 0) {
        can->torn += can->parts > 0; /* The earlier target is incomplete. */
        can->parts = 0;
    } else if (can->parts == 0) {
        return false; /* The rest of a target whose beginning was lost. */
    } else if (can->parts != index) {
        can->torn++;
        can->parts = 0;
        return false;
    }
    copy(block + 2 + 8 * index, data, 8);
    can->parts = index == 2 ? 0 : (uint8_t)(index + 1);
    if (index < 2)
        return false;
    /* The version is included, so that targets of another version are refused. */
    block[1] = can->version;
    if (cartpole_crc(block + 1, 23) != (uint16_t)(block[24] | (uint16_t)(block[25] << 8))) {
        can->errors++;
        return false;
    }
    block[0] = CARTPOLE_VERSION;
    block[1] = CARTPOLE_TARGET;
    return true;
}

static uint8_t write_info(const cartpole_can *can, const uint8_t *payload, cartpole_can_frame *out)
{
    static const uint8_t lengths[] = {6, 8, 8, 8, 5};
    uint8_t bytes[36], i, *at = bytes;
    *at++ = 0; /* In place of a version, so that any two versions can read each other's info. */
    *at++ = payload[2];
    *at++ = can->version;
    at = copy(at, payload + 22, 4); /* Rates, */
    at = copy(at, payload + 3, 16); /* kind, */
    at = copy(at, payload + 26, 8); /* unique id, */
    at = copy(at, payload + 19, 3); /* firmware. */
    cartpole_put(at, cartpole_crc(bytes, 34), 2);
    for (i = 0, at = bytes + 1; i < 5; at += lengths[i++])
        fill(can, (uint8_t)(INFO_1 + i), at, lengths[i], out + i);
    return 5;
}

uint8_t cartpole_can_receive(cartpole *device, cartpole_can *can, const cartpole_can_frame *frame,
                             const cartpole_motor *motor, cartpole_can_frame *out)
{
    static const uint8_t types[] = {CARTPOLE_STOP, 0, 0, 0, CARTPOLE_ARM, CARTPOLE_HOME, CARTPOLE_HELLO};
    uint8_t number = (uint8_t)(frame->id & 7), answer[CARTPOLE_MAX_PAYLOAD], bytes[4];
    uint8_t payload[3];
    /* Frames from devices, this one's own number included, are none of its business. */
    if ((frame->id & ~7UL) != (uint32_t)can->node << 5)
        return 0;
    if (number >= sizeof types || frame->length != (number >= TARGET_1 && number <= TARGET_3 ? 8 : 2)) {
        can->errors++;
        return 0;
    }
    if (number >= TARGET_1 && number <= TARGET_3) {
        if (join(can, (uint8_t)(number - TARGET_1), frame->data))
            cartpole_handle(device, can->target, 24, motor, answer);
        return 0;
    }
    /* Requests for the identity and for motor-off are obeyed in any version. */
    if ((number == ARM || number == HOME) && frame->data[1] != can->version) {
        can->errors++;
        return 0;
    }
    payload[0] = CARTPOLE_VERSION;
    payload[1] = types[number];
    payload[2] = frame->data[0];
    cartpole_handle(device, payload, 3, motor, answer);
    if (number == HELLO)
        return write_info(can, answer, out);
    copy(bytes, answer + 2, 3);
    bytes[3] = can->version;
    fill(can, ACK, bytes, 4, out);
    return 1;
}

uint8_t cartpole_can_report(cartpole *device, const cartpole_can *can, const cartpole_reading *reading,
                            cartpole_can_frame *out)
{
    uint8_t state[CARTPOLE_STATE_PAYLOAD], bytes[41], i, *at = bytes, count = 5, first = STATE_1;
    bool beat = device->state_count % CARTPOLE_STATES_PER_HEARTBEAT == 0;
    uint32_t torn = can->torn + can->errors;
    cartpole_state(device, reading, state);
    *at++ = can->version;
    if (device->encoder) {
        count = 2;
        first = ANGLE_1;
        at = copy(at, state + 22, 8);  /* Angle, velocity; */
        at = copy(at, state + 6, 4);   /* time, */
        *at++ = state[2];              /* low byte of the sequence, */
        *at++ = state[32];             /* status. */
    } else {
        at = copy(at, state + 2, 4);   /* Sequence, */
        at = copy(at, state + 33, 4);  /* of the command; */
        at = copy(at, state + 6, 6);   /* time, */
        *at++ = state[32];             /* status, */
        *at++ = state[2];              /* low byte of the sequence; */
        at = copy(at, state + 14, 18); /* positions, velocities; effort, */
        at = copy(at, state + 37, 4);  /* age of the command. */
    }
    cartpole_put(at, cartpole_crc(bytes, (uint8_t)(at - bytes)), 2);
    for (i = 0; i < count; i++)
        fill(can, (uint8_t)(first + i), bytes + 1 + 8 * i, 8, out + i);
    if (!beat)
        return count;
    cartpole_put(bytes, device->settings.unique_id, 4);
    bytes[4] = can->version;
    bytes[5] = state[32];
    bytes[6] = can->transmit_errors;
    bytes[7] = can->receive_errors;
    fill(can, HEARTBEAT, bytes, 8, out + count++);
    if (torn == 0 && can->overflows == 0 && can->bus_offs == 0 && can->drops == 0)
        return count;
    cartpole_put(bytes, torn > 0xFFFF ? 0xFFFF : torn, 2);
    cartpole_put(bytes + 2, can->overflows, 2);
    cartpole_put(bytes + 4, can->bus_offs, 2);
    cartpole_put(bytes + 6, can->drops, 2);
    fill(can, ERRORS, bytes, 8, out + count++);
    return count;
}
