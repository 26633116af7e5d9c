/* The firmware without a board: packets, requests, streams. See ../PROTOCOL.md. */
#ifndef GONIO_CORE_H
#define GONIO_CORE_H

#include <stdint.h>

#include "gonio_protocol.h"

#define GONIO_MAJOR 1u
#define GONIO_MINOR 0u
#define GONIO_PATCH 0u

/* Sizes that a port may change; they are told to the host in the hello. */
#ifndef GONIO_MAX_FRAMES
#define GONIO_MAX_FRAMES 32u
#endif
#ifndef GONIO_MAX_LIST
#define GONIO_MAX_LIST 16u
#endif
#ifndef GONIO_MAX_SCAN_BYTES
#define GONIO_MAX_SCAN_BYTES 182u
#endif
#ifndef GONIO_MAX_WAIT_US
#define GONIO_MAX_WAIT_US 4000u
#endif

/* Once, before anything else; the board is ready. */
void gonio_init(void);

/* From the main loop, for ever. Returns for how many microseconds there is nothing to do unless an interrupt
 * comes, so that a board may sleep; 0: call it again at once. */
uint32_t gonio_poll(void);

#define GONIO_IDLE 0xFFFFFFFFul /* only an interrupt brings work */

/* From the data-ready interrupt. */
void gonio_on_edge(uint32_t now_us);

#endif
