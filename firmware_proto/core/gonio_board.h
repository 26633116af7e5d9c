/* What the core needs of a board: the whole of a port is these functions. */
#ifndef GONIO_BOARD_H
#define GONIO_BOARD_H

#include <stdint.h>

#include "gonio_protocol.h"

/* GP_CAP_DATA_READY, GP_CAP_HARD_RESET: the board has that wire. GP_CAP_USB: it is a USB device itself. */
extern const uint16_t board_capabilities;

/* SPI clocks in Hz, fastest first, 0 where unused. */
extern const uint32_t board_clocks_hz[GP_CLOCKS];

/* Clock by its index in board_clocks_hz, least time of chip select high, least time between frame starts. */
void board_set_timing(uint8_t clock, uint16_t stall_us, uint16_t period_us);

/* One frame: waits until stall and period are over, sends 16 bits MSB first in mode 3, gives those received. */
uint16_t board_frame(uint16_t word);

/* Pulls the chip's RST line low for a time. */
void board_reset_chip(uint16_t low_us);

/* Which edge of data-ready calls gonio_on_edge(): 1 for the falling one. */
void board_select_edge(uint8_t falling);

/* Time in microseconds since power-on, wraps. */
uint32_t board_now_us(void);

/* Hold off and allow the interrupt that calls gonio_on_edge(). */
void board_lock(void);
void board_unlock(void);

/* A byte from the host: returns 0 where there is none. */
uint8_t board_receive(uint8_t *byte);

/* Bytes lost in the receiver since power-on, wraps. */
uint16_t board_receive_overruns(void);

/* Room in the transmitter, in bytes; a byte for it, called only where there is room; bytes so far may go. */
uint16_t board_send_room(void);
void board_send(uint8_t byte);
void board_send_now(void);

/* Board, a blank, serial number (without the blank where it has none); returns the length, at most room. */
uint8_t board_name(uint8_t *text, uint8_t room);

#endif
