/* The core as a shared library for host_firmware.py: plain numbers in and out, several bytes for each call. */
#include "../cartpole.h"

uint32_t host_size(void)
{
    return sizeof(cartpole);
}

uint32_t host_can_size(void)
{
    return sizeof(cartpole_can);
}

void host_init(cartpole *device, const cartpole_settings *settings, uint16_t (*draw_delay)(void))
{
    cartpole_init(device, settings);
    device->draw_delay = draw_delay;
}

/* The version differs from the protocol's in tests. */
void host_can_init(cartpole *device, cartpole_can *can, uint32_t node, uint32_t version, int encoder)
{
    cartpole_can_init(can, (uint8_t)node);
    can->version = (uint8_t)version;
    device->encoder = encoder != 0;
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

/* Data are whole frames as struct can_frame; out needs CARTPOLE_CAN_ANSWER for each. */
uint32_t host_can_receive(cartpole *device, cartpole_can *can, const uint8_t *data, uint32_t length,
                          int32_t position_nm, int32_t velocity_um_s, cartpole_can_frame *out)
{
    cartpole_motor motor = {position_nm, velocity_um_s};
    cartpole_can_frame frame;
    uint32_t written = 0, i;
    if (length % sizeof frame != 0) {
        can->errors++;
        return 0;
    }
    for (; length; length -= sizeof frame) {
        for (i = 0; i < sizeof frame; i++)
            ((uint8_t *)&frame)[i] = *data++;
        written += cartpole_can_receive(device, can, &frame, &motor, out + written);
    }
    return written * sizeof frame;
}

int host_control(cartpole *device, int32_t position_nm, int32_t velocity_um_s, int64_t *force_pn)
{
    cartpole_motor motor = {position_nm, velocity_um_s};
    return cartpole_control(device, &motor, force_pn);
}

uint32_t host_report(cartpole *device, int32_t cart_um, int32_t cart_um_s, int32_t pole_urad, int32_t pole_urad_s,
                     int32_t setpoint_nm, int at_end_stop, uint8_t *out)
{
    cartpole_reading reading = {cart_um, cart_um_s, pole_urad, pole_urad_s, setpoint_nm, at_end_stop != 0, false, 0};
    return cartpole_report(device, &reading, out);
}

uint32_t host_can_report(cartpole *device, const cartpole_can *can, int32_t cart_um, int32_t cart_um_s,
                         int32_t pole_urad, int32_t pole_urad_s, int32_t setpoint_nm, int at_end_stop,
                         cartpole_can_frame *out)
{
    cartpole_reading reading = {cart_um, cart_um_s, pole_urad, pole_urad_s, setpoint_nm, at_end_stop != 0, false, 0};
    return cartpole_can_report(device, can, &reading, out) * (uint32_t)sizeof *out;
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

uint32_t host_can_errors(const cartpole_can *can)
{
    return can->errors;
}
