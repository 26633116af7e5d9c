#include "usb.h"

#include <string.h>

#include "rp2040.h"

/* For tests at one's own bench only: docs/hardware.md. */
#ifndef USB_VID
#define USB_VID 0x1209u
#endif
#ifndef USB_PID
#define USB_PID 0x0001u
#endif
#define USB_RELEASE 0x0100u
#define MAKER "adis-gonio"
#define PRODUCT "adis-gonio bridge (RP2040)"

/* -- controller, 4.1 of the RP2040's data sheet ----------------------------------------------------- */

#define MEMORY 0x50100000u /* shared by the processor and the controller */
#define SETUP_PACKET ((const volatile uint8_t *)MEMORY)
#define IN 0u
#define OUT 1u
#define ENDPOINT_CONTROL(endpoint, way) REGISTER(MEMORY + 8u * (endpoint) + 4u * (way))
#define BUFFER_CONTROL(endpoint, way) REGISTER(MEMORY + 0x80u + 8u * (endpoint) + 4u * (way))
#define BUFFER(offset) ((volatile uint8_t *)(MEMORY + (offset)))
#define CONTROL_BUFFER 0x100u
#define NOTICE_BUFFER 0x180u
#define OUT_BUFFER 0x1c0u
#define IN_BUFFER 0x200u
#define MEMORY_SIZE 4096u

#define ENDPOINT_ON (1u << 31)
#define ENDPOINT_TELLS (1u << 29) /* an interrupt a buffer */
#define ENDPOINT_BULK (2u << 26)
#define ENDPOINT_INTERRUPT (3u << 26)
#define BUFFER_FULL (1u << 15)
#define BUFFER_DATA1 (1u << 13)
#define BUFFER_STALL (1u << 11)
#define BUFFER_AVAILABLE (1u << 10)
#define BUFFER_LENGTH 0x3ffu

#define ADDRESS 0x50110000u
#define MAIN_CONTROL 0x50110040u
#define MAIN_ON 1u
#define FRAME_NUMBER 0x50110048u
#define SIE_CONTROL 0x5011004cu
#define SIE_PULL_UP (1u << 16)
#define SIE_CONTROL_TELLS (1u << 29)
#define SIE_STATUS 0x50110050u
#define SIE_RESET (1u << 19)
#define SIE_SETUP (1u << 17)
#define BUFFER_STATUS 0x50110058u
#define STALL_ARM 0x50110068u
#define MUXING 0x50110074u
#define MUXING_TO_PHY 1u
#define MUXING_SOFTCON 8u
#define POWER 0x50110078u
#define POWER_VBUS 8u
#define POWER_OVERRIDE 4u
#define INTERRUPTS 0x50110090u
#define INTERRUPT_STATUS 0x50110098u
#define ON_BUFFER (1u << 4)
#define ON_RESET (1u << 12)
#define ON_SETUP (1u << 16)
#define ON_FRAME (1u << 17)
#define BUFFER_BIT(endpoint, way) (1u << (2u * (endpoint) + (way)))

/* Erratum E15: a transfer to the host that is cut off at the end of USB's frame of 1 ms, as behind a Raspberry
 * Pi 4's hub, may hang the controller. So none is offered after 800 us of a frame. The check comes 40 us before
 * that: the frame's interrupt may be late, and copying a packet takes time and may be interrupted. */
#define LATE_IN_FRAME_US 760u

#define CONTROL 0u
#define NOTICES 1u
#define DATA 2u
#define ENDPOINTS 3u
#define PACKET 64u

/* -- descriptors (USB 2.0, 9.6; CDC 1.2; PSTN 1.2) -------------------------------------------------- */

#define TWO(value) (uint8_t)(value), (uint8_t)((value) >> 8)
#define DEVICE 1u
#define CONFIGURATION 2u
#define STRING 3u
#define TEXTS 4u
#define CONFIGURATION_SIZE 75u

static const uint8_t device[] = {
    18, DEVICE, TWO(0x0200), 0xef, 2, 1, /* several interfaces, joined by an association */
    PACKET, TWO(USB_VID), TWO(USB_PID), TWO(USB_RELEASE), 1, 2, 3, 1,
};

static const uint8_t configuration[CONFIGURATION_SIZE] = {
    9, CONFIGURATION, TWO(CONFIGURATION_SIZE), 2, 1, 0, 0x80, 100, /* from the bus, 200 mA with the sensor */
    8, 11, 0, 2, 2, 2, 0, 0, /* both interfaces are one function */
    9, 4, 0, 0, 1, 2, 2, 0, 0, /* CDC ACM; no AT commands, so that no modem manager tries any */
    5, 0x24, 0, TWO(0x0110),
    5, 0x24, 1, 0, 1,
    4, 0x24, 2, 2, /* line coding and line state */
    5, 0x24, 6, 0, 1,
    7, 5, 0x80 | NOTICES, 3, TWO(8), 16,
    9, 4, 1, 0, 2, 10, 0, 0, 0, /* data */
    7, 5, DATA, 2, TWO(PACKET), 0,
    7, 5, 0x80 | DATA, 2, TWO(PACKET), 0,
};

typedef char descriptors_fit[sizeof device == 18u && sizeof configuration == CONFIGURATION_SIZE ? 1 : -1];

static char serial_number[USB_SERIAL_ROOM + 1u];
static const char *const texts[TEXTS] = {NULL, MAKER, PRODUCT, serial_number};

/* -- state ------------------------------------------------------------------------------------------- */

static uint8_t toggles[ENDPOINTS][2]; /* 1: the next packet is DATA1 */
static uint8_t configured;
static uint8_t line_coding[7] = {TWO(115200u & 0xffffu), TWO(115200u >> 16), 0, 0, 8};

/* The control transfer that runs. */
static struct {
    const uint8_t *next; /* what is left to send */
    uint16_t left;
    uint8_t ends_short;  /* an empty packet has to follow */
    uint8_t takes;       /* line coding comes next */
    uint8_t address;     /* to be taken once the host has the answer */
} transfer;
static uint8_t scratch[2u + 2u * 32u];

static volatile uint8_t out_ready; /* a packet from the host waits */
static uint8_t out_length, out_at;
static uint8_t ring[1024];                    /* bytes to the host */
static volatile uint16_t ring_head, ring_tail;
static uint16_t ring_end; /* head, once the bytes behind it may go */
static uint8_t in_flight, ends_full;
static uint32_t frame_us; /* begin of USB's frame */

#define RING_MASK (sizeof ring - 1u)

/* -- buffers ----------------------------------------------------------------------------------------- */

/* The controller may look at the register at any time: what it is to do is written first, and that it may
 * some cycles of its clock later (4.1.2.5.1). */
static void offer(uint32_t endpoint, uint32_t way, uint32_t what)
{
    if (toggles[endpoint][way] != 0u) {
        what |= BUFFER_DATA1;
    }
    toggles[endpoint][way] ^= 1u;
    BUFFER_CONTROL(endpoint, way) = what;
    __asm volatile("b 1f\n1: b 1f\n1: b 1f\n1: b 1f\n1: b 1f\n1: b 1f\n1:");
    BUFFER_CONTROL(endpoint, way) = what | BUFFER_AVAILABLE;
}

static void send_packet(uint32_t endpoint, uint32_t buffer, const uint8_t *data, uint32_t length)
{
    uint32_t k;
    for (k = 0; k < length; k++) {
        BUFFER(buffer)[k] = data[k];
    }
    offer(endpoint, IN, BUFFER_FULL | length);
}

/* -- bytes to and from the host, with the controller's interrupt held off ------------------------------- */

void usb_hold(void)
{
    REGISTER(NVIC_DISABLE) = 1u << IRQ_USB;
    __asm volatile("dsb\nisb" ::: "memory");
}

void usb_release(void)
{
    __asm volatile("" ::: "memory");
    REGISTER(NVIC_ENABLE) = 1u << IRQ_USB;
}

/* A packet of 64 bytes says that more is to come: one that ends with it is followed by an empty one. */
static void send_bytes(void)
{
    uint32_t length = 0;
    if (configured == 0u || in_flight != 0u || REGISTER(TIMER_RAWL) - frame_us >= LATE_IN_FRAME_US) {
        return; /* the next frame sends them */
    }
    while (length < PACKET && ring_tail != ring_head) {
        BUFFER(IN_BUFFER)[length++] = ring[ring_tail];
        ring_tail = (uint16_t)((ring_tail + 1u) & RING_MASK);
    }
    if (length == 0u && ends_full == 0u) {
        return;
    }
    ends_full = length == PACKET;
    in_flight = 1;
    offer(DATA, IN, BUFFER_FULL | length);
}

uint8_t usb_receive(uint8_t *byte)
{
    if (out_ready == 0u) {
        return 0;
    }
    __asm volatile("" ::: "memory");
    *byte = BUFFER(OUT_BUFFER)[out_at++];
    if (out_at == out_length) {
        usb_hold();
        out_ready = 0;
        if (configured != 0u) {
            offer(DATA, OUT, PACKET);
        }
        usb_release();
    }
    return 1;
}

uint16_t usb_room(void)
{
    return (uint16_t)((ring_tail - ring_end - 1u) & RING_MASK);
}

void usb_put(uint8_t byte)
{
    ring[ring_end] = byte;
    ring_end = (uint16_t)((ring_end + 1u) & RING_MASK);
}

void usb_flush(void)
{
    usb_hold();
    ring_head = ring_end;
    send_bytes();
    usb_release();
}

/* -- control transfers (USB 2.0, 9.4; PSTN 1.2, 6.3) ----------------------------------------------------- */

static void acknowledge(void)
{
    send_packet(CONTROL, CONTROL_BUFFER, NULL, 0);
}

static void refuse(void)
{
    SET(STALL_ARM) = BUFFER_BIT(CONTROL, IN) | BUFFER_BIT(CONTROL, OUT);
    BUFFER_CONTROL(CONTROL, IN) = BUFFER_STALL;
    BUFFER_CONTROL(CONTROL, OUT) = BUFFER_STALL;
}

static void answer_more(void)
{
    uint16_t length = transfer.left < PACKET ? transfer.left : PACKET;
    send_packet(CONTROL, CONTROL_BUFFER, transfer.next, length);
    transfer.next += length;
    transfer.left = (uint16_t)(transfer.left - length);
}

static void answer(const uint8_t *data, uint16_t length, uint16_t asked)
{
    transfer.ends_short = length < asked && length % PACKET == 0u;
    transfer.next = data;
    transfer.left = length < asked ? length : asked;
    answer_more();
}

static void answer_text(uint8_t index, uint16_t asked)
{
    uint8_t length = 2;
    if (index >= TEXTS) {
        refuse();
        return;
    }
    if (index == 0u) {
        scratch[length++] = 0x09; /* English, United States */
        scratch[length++] = 0x04;
    } else {
        const char *text;
        for (text = texts[index]; *text != '\0' && length < sizeof scratch; text++) {
            scratch[length++] = (uint8_t)*text;
            scratch[length++] = 0;
        }
    }
    scratch[0] = length;
    scratch[1] = STRING;
    answer(scratch, length, asked);
}

static void describe(uint8_t type, uint8_t index, uint16_t asked)
{
    if (type == DEVICE) {
        answer(device, sizeof device, asked);
    } else if (type == CONFIGURATION && index == 0u) {
        answer(configuration, sizeof configuration, asked);
    } else if (type == STRING) {
        answer_text(index, asked);
    } else {
        refuse();
    }
}

static void forget(void)
{
    configured = 0;
    out_ready = 0;
    in_flight = 0;
    ends_full = 0;
    BUFFER_CONTROL(NOTICES, IN) = 0;
    BUFFER_CONTROL(DATA, OUT) = 0;
    BUFFER_CONTROL(DATA, IN) = 0;
}

static void configure(uint8_t value)
{
    forget();
    memset(toggles[NOTICES], 0, sizeof toggles[NOTICES]);
    memset(toggles[DATA], 0, sizeof toggles[DATA]);
    if (value != 0u) {
        ENDPOINT_CONTROL(NOTICES, IN) = ENDPOINT_ON | ENDPOINT_TELLS | ENDPOINT_INTERRUPT | NOTICE_BUFFER;
        ENDPOINT_CONTROL(DATA, OUT) = ENDPOINT_ON | ENDPOINT_TELLS | ENDPOINT_BULK | OUT_BUFFER;
        ENDPOINT_CONTROL(DATA, IN) = ENDPOINT_ON | ENDPOINT_TELLS | ENDPOINT_BULK | IN_BUFFER;
        configured = 1;
        offer(DATA, OUT, PACKET);
        send_bytes();
    }
}

/* The host begins an endpoint anew with DATA0; what it has not fetched yet is offered again. */
static void unhalt(uint8_t address)
{
    uint32_t way = (address & 0x80u) != 0u ? IN : OUT;
    uint32_t what = BUFFER_CONTROL(DATA, way);
    if ((address & 0x7fu) == DATA && configured != 0u) {
        toggles[DATA][way] = 0;
        if ((what & BUFFER_AVAILABLE) != 0u) {
            BUFFER_CONTROL(DATA, way) = 0;
            offer(DATA, way, what & (BUFFER_FULL | BUFFER_LENGTH));
        }
    }
    acknowledge();
}

#define REQUEST(type, request) ((uint16_t)(((type) << 8) | (request)))

static void on_setup(void)
{
    uint8_t packet[8];
    uint16_t value, index, length;
    uint32_t k;
    for (k = 0; k < sizeof packet; k++) {
        packet[k] = SETUP_PACKET[k];
    }
    value = (uint16_t)(packet[2] | (packet[3] << 8));
    index = (uint16_t)(packet[4] | (packet[5] << 8));
    length = (uint16_t)(packet[6] | (packet[7] << 8));
    BUFFER_CONTROL(CONTROL, IN) = 0; /* whatever ran before is over */
    BUFFER_CONTROL(CONTROL, OUT) = 0;
    toggles[CONTROL][IN] = toggles[CONTROL][OUT] = 1;
    memset(&transfer, 0, sizeof transfer);
    switch (REQUEST(packet[0], packet[1])) {
    case REQUEST(0x80, 6): /* GET_DESCRIPTOR */
        describe((uint8_t)(value >> 8), (uint8_t)value, length);
        break;
    case REQUEST(0x00, 5): /* SET_ADDRESS */
        transfer.address = (uint8_t)value;
        acknowledge();
        break;
    case REQUEST(0x00, 9): /* SET_CONFIGURATION */
        if (value > 1u) {
            refuse();
            break;
        }
        configure((uint8_t)value);
        acknowledge();
        break;
    case REQUEST(0x80, 8): /* GET_CONFIGURATION */
        answer(&configured, 1, length);
        break;
    case REQUEST(0x80, 0): /* GET_STATUS of device, interface, endpoint: nothing is set */
    case REQUEST(0x81, 0):
    case REQUEST(0x82, 0):
        memset(scratch, 0, 2);
        answer(scratch, 2, length);
        break;
    case REQUEST(0x02, 1): /* CLEAR_FEATURE: ENDPOINT_HALT */
        unhalt((uint8_t)index);
        break;
    case REQUEST(0x81, 10): /* GET_INTERFACE */
        scratch[0] = 0;
        answer(scratch, 1, length);
        break;
    case REQUEST(0x01, 11): /* SET_INTERFACE: there is one setting */
        if (value != 0u) {
            refuse();
            break;
        }
        acknowledge();
        break;
    case REQUEST(0x21, 0x20): /* SET_LINE_CODING */
        transfer.takes = 1;
        offer(CONTROL, OUT, PACKET);
        break;
    case REQUEST(0xa1, 0x21): /* GET_LINE_CODING */
        answer(line_coding, sizeof line_coding, length);
        break;
    case REQUEST(0x21, 0x22): /* SET_CONTROL_LINE_STATE: nothing hangs on DTR and RTS */
    case REQUEST(0x21, 0x23): /* SEND_BREAK */
        acknowledge();
        break;
    default:
        refuse();
        break;
    }
}

static void on_control_in(void)
{
    if (transfer.left != 0u) {
        answer_more();
    } else if (transfer.ends_short != 0u) {
        transfer.ends_short = 0;
        send_packet(CONTROL, CONTROL_BUFFER, NULL, 0);
    } else if (transfer.next != NULL) {
        transfer.next = NULL;
        toggles[CONTROL][OUT] = 1;
        offer(CONTROL, OUT, 0); /* the host's acknowledgement */
    } else if (transfer.address != 0u) {
        REGISTER(ADDRESS) = transfer.address;
        transfer.address = 0;
    }
}

static void on_control_out(void)
{
    if (transfer.takes != 0u) {
        transfer.takes = 0;
        if ((BUFFER_CONTROL(CONTROL, OUT) & BUFFER_LENGTH) == sizeof line_coding) {
            uint32_t k;
            for (k = 0; k < sizeof line_coding; k++) {
                line_coding[k] = BUFFER(CONTROL_BUFFER)[k];
            }
        }
        acknowledge();
    }
}

static void on_data_out(void)
{
    out_length = (uint8_t)(BUFFER_CONTROL(DATA, OUT) & BUFFER_LENGTH);
    out_at = 0;
    if (out_length == 0u) {
        offer(DATA, OUT, PACKET);
    } else {
        out_ready = 1;
    }
}

void usb_interrupt(void)
{
    uint32_t status = REGISTER(INTERRUPT_STATUS);
    if ((status & ON_FRAME) != 0u) {
        (void)REGISTER(FRAME_NUMBER); /* which acknowledges it */
        frame_us = REGISTER(TIMER_RAWL);
        send_bytes();
    }
    if ((status & ON_RESET) != 0u) {
        REGISTER(SIE_STATUS) = SIE_RESET;
        REGISTER(ADDRESS) = 0;
        forget();
        memset(&transfer, 0, sizeof transfer);
    }
    if ((status & ON_BUFFER) != 0u) {
        uint32_t done = REGISTER(BUFFER_STATUS);
        REGISTER(BUFFER_STATUS) = done;
        if ((done & BUFFER_BIT(CONTROL, IN)) != 0u) {
            on_control_in();
        }
        if ((done & BUFFER_BIT(CONTROL, OUT)) != 0u) {
            on_control_out();
        }
        if ((done & BUFFER_BIT(DATA, OUT)) != 0u && configured != 0u) {
            on_data_out();
        }
        if ((done & BUFFER_BIT(DATA, IN)) != 0u && configured != 0u) {
            in_flight = 0;
            send_bytes();
        }
    }
    if ((status & ON_SETUP) != 0u) {
        REGISTER(SIE_STATUS) = SIE_SETUP;
        on_setup();
    }
}

void usb_start(const char *serial)
{
    uint32_t at;
    strncpy(serial_number, serial, USB_SERIAL_ROOM);
    for (at = 0; at < MEMORY_SIZE; at += 4u) {
        REGISTER(MEMORY + at) = 0;
    }
    REGISTER(MUXING) = MUXING_TO_PHY | MUXING_SOFTCON;
    REGISTER(POWER) = POWER_VBUS | POWER_OVERRIDE; /* the Pico has no wire to see it by: it lives of it */
    REGISTER(MAIN_CONTROL) = MAIN_ON;
    REGISTER(SIE_CONTROL) = SIE_CONTROL_TELLS;
    REGISTER(INTERRUPTS) = ON_BUFFER | ON_RESET | ON_SETUP | ON_FRAME;
    usb_release();
    SET(SIE_CONTROL) = SIE_PULL_UP;
}
