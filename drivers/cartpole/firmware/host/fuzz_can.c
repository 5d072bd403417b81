/* Fuzz run of the CAN frames: a bus that loses, repeats, moves, mixes, changes and invents frames, from a seed.
 *
 * Usage: fuzz_can INPUTS SEED. As fuzz.c. An input is a target of three frames, a request, or frames of any kind. The
 * node is armed before each, so that a target that it takes is seen by its age.
 */
#include "fuzz.h"

#define NODE 5

static uint8_t target_of(cartpole_can_frame *frames, uint8_t *body)
{
    uint8_t block[25], i;
    uint16_t crc;
    block[0] = CARTPOLE_VERSION;
    for (i = 0; i < 22; i++)
        block[1 + i] = body[i] = draw(3) ? (uint8_t)draw(256) : 0;
    crc = cartpole_crc(block, 23);
    block[23] = (uint8_t)crc;
    block[24] = (uint8_t)(crc >> 8);
    for (i = 0; i < 3; i++) {
        frames[i].id = NODE << 5 | (1u + i);
        frames[i].length = 8;
        memcpy(frames[i].data, block + 1 + 8 * i, 8);
    }
    return 3;
}

static uint8_t mutate(cartpole_can_frame *frames, const cartpole_can_frame *before, uint32_t kind)
{
    uint8_t i, at = (uint8_t)draw(3);
    switch (kind) {
    case 0: /* A frame lost. */
        memmove(frames + at, frames + at + 1, sizeof *frames * (2u - at));
        return 2;
    case 1: /* A frame in another's place. */
        frames[at] = frames[(at + 1u + draw(2)) % 3];
        return 3;
    case 2: /* A frame of the target before. */
        frames[at] = before[at];
        return 3;
    case 3: /* One to four bits. */
        for (i = (uint8_t)(1 + draw(4)); i; i--)
            frames[draw(3)].data[draw(8)] ^= (uint8_t)(1u << draw(8));
        return 3;
    case 4: /* Another id or length. */
        if (draw(2))
            frames[at].id ^= 1u << draw(32);
        else
            frames[at].length = (uint8_t)draw(256);
        return 3;
    default: /* A frame's data. */
        for (i = 0; i < 8; i++)
            frames[at].data[i] = (uint8_t)draw(256);
        return 3;
    }
}

static uint8_t invent(cartpole_can_frame *frames)
{
    uint8_t count = (uint8_t)(1 + draw(8)), i, j;
    for (i = 0; i < count; i++) {
        /* Half of them in the order of a target. */
        frames[i].id = draw(2) ? NODE << 5 | (1u + i % 3) : draw(4) ? NODE << 5 | draw(32) : draw(0xFFFFFFFF);
        frames[i].length = draw(4) ? (uint8_t)(draw(3) ? 8 : 2) : (uint8_t)draw(256);
        for (j = 0; j < 8; j++)
            frames[i].data[j] = draw(3) ? (uint8_t)draw(256) : CARTPOLE_VERSION;
    }
    return count;
}

int main(int count, char **words)
{
    fuzz_counts counts = {count > 1 ? strtoull(words[1], NULL, 10) : 100000, 0, 0, 0, 0, 0, 0};
    uint64_t number;
    cartpole_settings settings = {CARTPOLE_ONE, CARTPOLE_ONE, CARTPOLE_ONE, CARTPOLE_ONE, 1, 2};
    cartpole device;
    cartpole_can can;
    cartpole_can_frame before[3];
    memset(before, 0, sizeof before);
    state = count > 2 ? strtoull(words[2], NULL, 10) : 1;
    cartpole_init(&device, &settings);
    cartpole_can_init(&can, NODE);
    for (number = 0; number < counts.inputs; number++) {
        cartpole_can_frame sent[8], whole[3], out[CARTPOLE_CAN_REPORT], *exact;
        cartpole_motor motor = {(int32_t)draw(0xFFFFFFFF), (int32_t)draw(0xFFFFFFFF)};
        cartpole_reading reading = draw_reading();
        uint8_t body[22], length, i, j, made, taken = 0;
        uint32_t kind = draw(10);
        bool same = kind >= 8;
        int64_t force_pn;
        memset(sent, 0, sizeof sent);
        length = target_of(sent, body);
        memcpy(whole, sent, sizeof whole);
        if (kind < 6) {
            length = mutate(sent, before, kind);
            same = length == 3 && memcmp(whole, sent, sizeof whole) == 0;
            counts.corrupt += !same;
        } else if (kind < 8) {
            length = invent(sent);
            counts.garbage++;
        } else {
            counts.good++;
        }
        memcpy(before, whole, sizeof before);
        device.mode = CARTPOLE_ARMED;
        device.homed = true;
        device.command_sequence = CARTPOLE_NO_COMMAND;
        /* An exact copy on the heap, so that a read beyond its end is detected. */
        if ((exact = malloc(sizeof *exact * length)) == NULL)
            return 2;
        memcpy(exact, sent, sizeof *exact * length);
        for (i = 0; i < length; i++) {
            device.command_age = 1;
            made = cartpole_can_receive(&device, &can, exact + i, &motor, out);
            taken = (uint8_t)(taken + (device.command_age == 0));
            CHECK(made <= CARTPOLE_CAN_ANSWER);
            for (j = 0; j < made; j++)
                CHECK(out[j].id >> 3 > NODE << 2 && out[j].id >> 5 == NODE && out[j].length <= 8);
        }
        free(exact);
        /* Frames of two inputs may be in order: only the CRC tells. */
        if (kind < 6 && !same)
            counts.accepted += taken > 0;
        else if (kind >= 6 && kind < 8)
            counts.garbage_accepted += taken;
        else if (memcmp(body, "\xFF\xFF\xFF\xFF", 4) != 0)
            CHECK(taken == 1 && memcmp(can.target + 2, body, sizeof body) == 0);
        if (cartpole_control(&device, &motor, &force_pn)) {
            made = cartpole_can_report(&device, &can, &reading, out);
            CHECK(made >= 5 && made <= CARTPOLE_CAN_REPORT);
        }
        check_core(number, &device, force_pn);
        CHECK(can.parts < 3);
        counts.armed += device.mode == CARTPOLE_ARMED;
        if (draw(4) == 0)
            cartpole_finish_homing(&device);
    }
    print(&counts);
    return 0;
}
