/* A board without hardware: what a test puts in and gets out. */
#ifndef GONIO_HOST_BOARD_H
#define GONIO_HOST_BOARD_H

#include <stdint.h>

/* Called for every frame; gives the word shifted out. NULL: the words count up from 0. */
extern uint16_t (*host_frame_hook)(uint16_t word);

/* Power-on. */
void host_start(void);

/* Bytes from the host's side; returns how many had room. */
uint32_t host_feed(const uint8_t *bytes, uint32_t count);

/* Bytes that the firmware has sent; returns how many. */
uint32_t host_take(uint8_t *bytes, uint32_t room);

/* Run the main loop so many times. */
void host_poll(uint32_t times);

/* Set the clock; an edge of data-ready at its present time. */
void host_set_time(uint32_t now_us);
void host_edge(void);

/* Free bytes of the transmitter that the firmware sees, at most. */
void host_limit_room(uint16_t room);

/* Timing and edge in force, time that RST was low, and how often the lock was not paired. */
uint32_t host_timing(uint32_t *stall_us, uint32_t *period_us);
uint8_t host_falling(void);
uint32_t host_reset_us(void);
uint32_t host_lock_errors(void);

#endif
