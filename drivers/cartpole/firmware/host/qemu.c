/* The core on a Cortex-M3 under QEMU: takes recorded calls from the file "inputs" and writes their results to the file
 * "outputs", by semihosting. tools/firmware_inputs.py records the calls from the host's core.
 */
#include "../cartpole.h"
#include "../stm32/stm32f103.h"

#define SYS_OPEN 1
#define SYS_WRITE 5
#define SYS_READ 6
#define SYS_EXIT 0x18
#define BINARY_READ 1
#define BINARY_WRITE 5
#define APPLICATION_EXIT 0x20026

void host_init(cartpole *device, const cartpole_settings *settings, uint16_t (*draw_delay)(void));
void host_can_init(cartpole *device, cartpole_can *can, uint32_t node, uint32_t version, int encoder);
uint32_t host_receive(cartpole *device, const uint8_t *data, uint32_t length, int32_t position_nm,
                      int32_t velocity_um_s, uint8_t *out);
uint32_t host_can_receive(cartpole *device, cartpole_can *can, const uint8_t *data, uint32_t length,
                          int32_t position_nm, int32_t velocity_um_s, cartpole_can_frame *out);
int host_control(cartpole *device, int32_t position_nm, int32_t velocity_um_s, int64_t *force_pn);
uint32_t host_report(cartpole *device, int32_t cart_um, int32_t cart_um_s, int32_t pole_urad, int32_t pole_urad_s,
                     int32_t setpoint_nm, int at_end_stop, uint8_t *out);
uint32_t host_can_report(cartpole *device, const cartpole_can *can, int32_t cart_um, int32_t cart_um_s,
                         int32_t pole_urad, int32_t pole_urad_s, int32_t setpoint_nm, int at_end_stop,
                         cartpole_can_frame *out);
void host_look(const cartpole *device, int32_t look[6]);
uint32_t host_can_errors(const cartpole_can *can);
int main(void);

static cartpole device;
static cartpole_can can;
static uint32_t in, out;

static uint32_t ask(uint32_t operation, const void *argument)
{
    register uint32_t r0 __asm__("r0") = operation;
    register const void *r1 __asm__("r1") = argument;
    __asm__ volatile("bkpt 0xAB" : "+r"(r0) : "r"(r1) : "memory");
    return r0;
}

static uint32_t open(const char *name, uint32_t length, uint32_t mode)
{
    uint32_t block[3] = {(uint32_t)name, mode, length};
    return ask(SYS_OPEN, block);
}

static uint32_t take(void *to, uint32_t length)
{
    uint32_t block[3] = {in, (uint32_t)to, length};
    return length - ask(SYS_READ, block); /* It returns what it did not read. */
}

static void give(const void *from, uint32_t length)
{
    uint32_t block[3] = {out, (uint32_t)from, length};
    ask(SYS_WRITE, block);
}

int main(void)
{
    static uint8_t data[256];
    static cartpole_can_frame frames[(sizeof data / sizeof(cartpole_can_frame) + 1) * CARTPOLE_CAN_ANSWER];
    uint8_t *answer = (uint8_t *)frames; /* Of either wire. */
    uint8_t call;
    in = open("inputs", 6, BINARY_READ);
    out = open("outputs", 7, BINARY_WRITE);
    while (take(&call, 1) == 1) {
        int32_t v[6], look[6];
        uint32_t length = 0;
        int64_t force_pn;
        cartpole_settings settings;
        switch (call) {
        case 'I':
            take(&settings, sizeof settings);
            take(v, 12);
            host_init(&device, &settings, 0);
            host_can_init(&device, &can, (uint32_t)v[0], (uint32_t)v[1], v[2]);
            break;
        case 'R':
        case 'r':
            take(&length, 4);
            take(data, length);
            take(v, 8);
            length = call == 'R' ? host_receive(&device, data, length, v[0], v[1], answer)
                                 : host_can_receive(&device, &can, data, length, v[0], v[1], frames);
            give(answer, length);
            break;
        case 'C':
            take(v, 8);
            length = (uint32_t)host_control(&device, v[0], v[1], &force_pn);
            host_look(&device, look);
            give(&length, 4);
            give(&force_pn, 8);
            give(look, sizeof look);
            break;
        case 'S':
        case 's':
            take(v, 24);
            length = call == 'S' ? host_report(&device, v[0], v[1], v[2], v[3], v[4], v[5], answer)
                                 : host_can_report(&device, &can, v[0], v[1], v[2], v[3], v[4], v[5], frames);
            give(answer, length);
            break;
        default:
            cartpole_finish_homing(&device);
        }
    }
    ask(SYS_EXIT, (const void *)APPLICATION_EXIT);
    return 0;
}
