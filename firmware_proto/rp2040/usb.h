/* A serial port by USB (CDC-ACM, full speed) on the RP2040's own controller. There is no baud rate: what the
 * host sets is remembered and told back, and changes nothing. */
#ifndef USB_H
#define USB_H

#include <stdint.h>

#define USB_SERIAL_ROOM 16u

/* Once, with clk_usb at 48 MHz; the serial number is up to USB_SERIAL_ROOM letters. The host sees the board. */
void usb_start(const char *serial);

/* From the controller's interrupt. */
void usb_interrupt(void);

/* Hold off the controller's interrupt, and allow it; the host waits meanwhile. Not nested. */
void usb_hold(void);
void usb_release(void);

/* A byte from the host: returns 0 where there is none. While one waits the host is held off; none is lost. */
uint8_t usb_receive(uint8_t *byte);

/* Bytes that usb_put() takes; put one; let go those that were put. */
uint16_t usb_room(void);
void usb_put(uint8_t byte);
void usb_flush(void);

#endif
