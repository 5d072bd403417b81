/* What the fuzzers share: draws from a seed, checks of the core, the line of counts. */
#ifndef FUZZ_H
#define FUZZ_H

#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "../cartpole.h"

#define CHECK(what)                                                        \
    do {                                                                   \
        if (!(what)) {                                                     \
            fprintf(stderr, "input %" PRIu64 ": %s\n", number, #what);     \
            abort();                                                       \
        }                                                                  \
    } while (0)

static uint64_t state;

static uint32_t draw(uint32_t below) /* splitmix64 */
{
    uint64_t z = (state += 0x9E3779B97F4A7C15ULL);
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9ULL;
    z = (z ^ (z >> 27)) * 0x94D049BB133111EBULL;
    return (uint32_t)(((z ^ (z >> 31)) >> 32) * below >> 32);
}

static cartpole_reading draw_reading(void)
{
    cartpole_reading drawn = {(int32_t)draw(0xFFFFFFFF), (int32_t)draw(0xFFFFFFFF), (int32_t)draw(0xFFFFFFFF),
                              (int32_t)draw(0xFFFFFFFF), (int32_t)draw(0xFFFFFFFF), draw(2), draw(2),
                              (uint16_t)draw(1000)};
    return drawn;
}

static void check_core(uint64_t number, const cartpole *device, int64_t force_pn)
{
    CHECK(device->mode == CARTPOLE_ARMED || force_pn == 0);
    CHECK(force_pn <= device->servo.real.limit_pn && force_pn >= -device->servo.real.limit_pn);
    CHECK(device->queue_count <= CARTPOLE_QUEUE && device->mode <= CARTPOLE_ARMED);
    CHECK(device->mode != CARTPOLE_ARMED || device->homed);
}

/* "accepted" counts what was taken of corrupt or random frames, whose CRC happened to be right. */
typedef struct {
    uint64_t inputs, good, corrupt, accepted, garbage, garbage_accepted, armed;
} fuzz_counts;

static void print(const fuzz_counts *c)
{
    printf("{\"inputs\": %" PRIu64 ", \"good\": %" PRIu64 ", \"corrupt\": %" PRIu64 ", \"accepted\": %" PRIu64
           ", \"garbage\": %" PRIu64 ", \"garbage_accepted\": %" PRIu64 ", \"armed\": %" PRIu64 "}\n",
           c->inputs, c->good, c->corrupt, c->accepted, c->garbage, c->garbage_accepted, c->armed);
}

#endif
