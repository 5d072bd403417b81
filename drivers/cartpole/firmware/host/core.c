/* The core as a shared library for host_firmware.py: plain numbers in and out, several bytes for each call. */
#include "../cartpole.h"

uint32_t host_size(void)
{
    return sizeof(cartpole);
}

void host_init(cartpole *device, const cartpole_settings *settings, uint16_t (*draw_delay)(void))
{
    cartpole_init(device, settings);
    device->draw_delay = draw_delay;
}

/* A frame has at least 5 bytes, so that out needs CARTPOLE_MAX_FRAME for each 5 bytes and the rest from before. */
uint32_t host_receive(cartpole *device, const uint8_t *data, uint32_t length, int32_t position_nm,
                      int32_t velocity_um_s, uint8_t *out)
{
    cartpole_motor motor = {position_nm, velocity_um_s};
    uint32_t written = 0;
    for (; length; length--)
        written += cartpole_receive(device, *data++, &motor, out + written);
    return written;
}

int host_control(cartpole *device, int32_t position_nm, int32_t velocity_um_s, int64_t *force_pn)
{
    cartpole_motor motor = {position_nm, velocity_um_s};
    return cartpole_control(device, &motor, force_pn);
}

uint32_t host_report(cartpole *device, int32_t cart_um, int32_t cart_um_s, int32_t pole_urad, int32_t pole_urad_s,
                     int32_t setpoint_nm, int at_end_stop, uint8_t *out)
{
    cartpole_reading reading = {cart_um, cart_um_s, pole_urad, pole_urad_s, setpoint_nm, at_end_stop != 0, false};
    return cartpole_report(device, &reading, out);
}

/* Mode, watchdog, frame errors, homings, armings, set-point [nm]. */
void host_look(const cartpole *device, int32_t look[6])
{
    look[0] = device->mode;
    look[1] = device->watchdog;
    look[2] = (int32_t)device->decoder.errors;
    look[3] = (int32_t)device->homings;
    look[4] = (int32_t)device->armings;
    look[5] = device->servo.setpoint_nm;
}
