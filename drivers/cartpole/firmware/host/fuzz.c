/* Fuzz run of the frame decoder and of the whole core: random, mutated and spliced frames, from a seed.
 *
 * Usage: fuzz INPUTS SEED. Prints one line of counts; aborts if the core violates an assertion. Build it with
 * -fsanitize=address,undefined. "accepted" counts corrupt frames whose CRC happened to be right.
 */
#include "fuzz.h"

static uint8_t payload_of(uint8_t *payload)
{
    static const uint8_t types[] = {CARTPOLE_TARGET, CARTPOLE_TARGET, CARTPOLE_TARGET, CARTPOLE_ARM,
                                    CARTPOLE_ARM,    CARTPOLE_HOME,   CARTPOLE_STOP,   CARTPOLE_HELLO};
    uint8_t i, length;
    payload[0] = CARTPOLE_VERSION;
    payload[1] = types[draw(sizeof types)];
    length = payload[1] == CARTPOLE_TARGET ? 24 : 3;
    for (i = 2; i < length; i++)
        payload[i] = draw(3) ? (uint8_t)draw(256) : 0;
    return length;
}

static uint8_t mutate(uint8_t *data, uint8_t length, uint32_t kind)
{
    uint8_t i, at = (uint8_t)draw(length);
    switch (kind) {
    case 0: /* One to four bits. */
        for (i = (uint8_t)(1 + draw(4)); i; i--, at = (uint8_t)draw(length))
            data[at] ^= (uint8_t)(1u << draw(8));
        return length;
    case 1: /* A byte. */
        data[at] ^= (uint8_t)(1 + draw(255));
        return length;
    case 2: /* A byte lost. */
        memmove(data + at, data + at + 1, (size_t)(length - at - 1));
        return (uint8_t)(length - 1);
    case 3: /* A byte too many. */
        memmove(data + at + 1, data + at, (size_t)(length - at));
        data[at] = (uint8_t)draw(256);
        return (uint8_t)(length + 1);
    case 4: /* Cut short. */
        return at;
    default: /* Several bytes in a row. */
        for (i = 0; at < length && i < 16; i++, at++)
            data[at] = (uint8_t)draw(256);
        return length;
    }
}

int main(int count, char **words)
{
    fuzz_counts counts = {count > 1 ? strtoull(words[1], NULL, 10) : 100000, 0, 0, 0, 0, 0, 0};
    uint64_t number;
    cartpole_settings settings = {CARTPOLE_ONE, CARTPOLE_ONE, CARTPOLE_ONE, CARTPOLE_ONE, 1, 2};
    cartpole device;
    state = count > 2 ? strtoull(words[2], NULL, 10) : 1;
    cartpole_init(&device, &settings);
    for (number = 0; number < counts.inputs; number++) {
        uint8_t payload[CARTPOLE_MAX_PAYLOAD], data[160], frame[CARTPOLE_MAX_FRAME], *out;
        cartpole_decoder decoder = {{0}, 0, true, 0};
        cartpole_motor motor = {(int32_t)draw(0xFFFFFFFF), (int32_t)draw(0xFFFFFFFF)};
        cartpole_reading reading = draw_reading();
        uint32_t kind = draw(10);
        uint8_t size = payload_of(payload), length, got, i, first = 0;
        bool same = kind >= 8;
        int64_t force_pn;
        length = cartpole_frame(payload, size, data);
        CHECK(length <= CARTPOLE_MAX_FRAME && memchr(data, 0, length) == data + length - 1);
        if (kind < 6) {
            uint8_t before[CARTPOLE_MAX_FRAME], was = length;
            memcpy(before, data, length);
            length = mutate(data, length, kind);
            same = length == was && memcmp(before, data, length) == 0;
            counts.corrupt += !same;
        } else if (kind < 8) { /* No frame at all; half of them look like one. */
            length = (uint8_t)(1 + draw(140));
            for (i = 0; i < length; i++)
                data[i] = (uint8_t)(kind == 6 ? draw(256) : 1 + draw(length));
            counts.garbage++;
        } else {
            counts.good++;
        }
        if (length == 0 || data[length - 1] != 0)
            data[length++] = 0;
        for (i = 0; i < length; i++) {
            if ((got = cartpole_decode(&decoder, data[i])) == 0)
                continue;
            CHECK(got <= CARTPOLE_MAX_PAYLOAD && got >= 2);
            if (kind >= 8 || (kind < 6 && got == size && memcmp(decoder.block, payload, size) == 0)) {
                CHECK(got == size && memcmp(decoder.block, payload, size) == 0);
                first = 1;
            } else if (kind < 6) {
                counts.accepted++;
            } else {
                counts.garbage_accepted++;
            }
        }
        CHECK(!same || first);
        /* An exact copy on the heap, so that a read beyond its end is detected. */
        if ((out = malloc(length)) == NULL)
            return 2;
        memcpy(out, data, length);
        for (i = 0; i < length; i++)
            CHECK(cartpole_receive(&device, out[i], &motor, frame) <= CARTPOLE_MAX_FRAME);
        free(out);
        if (cartpole_control(&device, &motor, &force_pn))
            CHECK(cartpole_report(&device, &reading, frame) <= 48);
        check_core(number, &device, force_pn);
        counts.armed += device.mode == CARTPOLE_ARMED;
        if (draw(4) == 0)
            cartpole_finish_homing(&device);
    }
    print(&counts);
    return 0;
}
