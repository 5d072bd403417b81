/* What the programs for the STM32F103C8 share: clock, pins, encoders, CAN, settings. Everything is polled. */
#ifndef BOARD_H
#define BOARD_H

#include "../rig.h"
#include "stm32f103.h"

#define CORE_HZ 72000000UL

#define MOTOR_REVERSE 5   /* PA */
#define BOOT1 2           /* PB */
#define LEFT_SWITCH 12    /* The button of a pole encoder node. */
#define RIGHT_SWITCH 13
#define LED_ARMED 14
#define LED_SET_POLE 13   /* PC, on the board: low is on. */

/* The settings in the last page of the flash, CRC-16/IBM-3740 last; without them the nominal ones apply. */
typedef struct {
    uint32_t stiffness_trim, damping_trim, effort_trim, speed_trim, unique_id;
    uint16_t delay_ticks, full_force_mn, node, can_kbit;
    uint16_t drive; /* Of a pole encoder node: the motor drive's number. */
    uint16_t crc;
} stored_settings;

#ifdef HOST
extern stored_settings stored;
#else
#define stored (*(const stored_settings *)0x0800FC00UL)
#endif

extern cartpole_can can;
extern rig robot;

void set_pin(uint32_t port, uint32_t pin, bool high);
void set_mode(uint32_t port, uint32_t pin, uint32_t mode);
void pull_up(uint32_t port, uint32_t pin);
void set_up_encoder(uint32_t timer);
/* Set up clock, pole encoder, left switch and lamp; return the settings. The node is the one without settings. */
stored_settings set_up_board(uint16_t node);
void set_up_can(const stored_settings *settings);
/* Start the millisecond, and the watchdog that resets a control loop that hangs. */
void start_ticks(void);
/* Queue a message's frames, or drop all of them. */
void send_can(const cartpole_can_frame *frames, uint8_t length);
/* Serve the controller; return whether the motor drive's estimates came, which only a pole encoder node gets. */
bool serve_can(void);

#endif
