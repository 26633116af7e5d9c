/* The firmware's ELF on simavr's core, the line-level chip on its pins, a pty as its serial port.
 *
 * SPI master, UART and pins are this file's own: simavr's do not make edges. Time is the simulated board's; it never
 * runs ahead of the wall clock (speed=1) and does not catch up where the machine was busy.
 *
 *   rig elf=gonio.elf [vcd=FILE] [NAME=VALUE ...]     NAME: see options below, or a parameter of the chip
 *
 * vcd=FILE is a capture of the pins as of a logic analyser, complete after each report.
 *
 * First line on stdout: the pty. Then one line for each line on stdin: report | set NAME VALUE | input NAME VALUE |
 * forget | quit. The board starts, and restarts, when the pty is opened, and stands still while it is closed.
 */
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/inotify.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#include <simavr/avr_extint.h>
#include <simavr/avr_ioport.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>
#include <simavr/sim_io.h>

#include "boot.h"
#include "chip.h"
#include "uart.h"

/* -- ATmega328P ------------------------------------------------------------------------------------------- */

enum { R_PINB = 0x23, R_DDRB = 0x24, R_PORTB = 0x25, R_EIFR = 0x3C, R_SPCR = 0x4C, R_SPSR = 0x4D, R_SPDR = 0x4E,
       R_UCSRA = 0xC0, R_UCSRB = 0xC1, R_UBRRL = 0xC4, R_UBRRH = 0xC5, R_UDR = 0xC6 };
enum { RST = 1, CS = 2, MOSI = 3, MISO = 4, SCK = 5 }; /* of port B */
enum { RXC = 0x80, TXC = 0x40, UDRE = 0x20, FE = 0x10, DOR = 0x08, U2X = 0x02 };
enum { RXEN = 0x10, TXEN = 0x08 };
enum { SPIF = 0x80, WCOL = 0x40, SPI2X = 0x01, SPE = 0x40, DORD = 0x20, MSTR = 0x10, CPOL = 0x08, CPHA = 0x04 };

#define F_CPU 16000000u
#define SLICE_PS (250 * PS_US)

/* -- options ------------------------------------------------------------------------------------------------ */

static struct {
    const char *elf, *clock;
    double baud;          /* the host's, against the board's own clock */
    double latency_ms;    /* of the USB adapter: it holds bytes back for so long, or until 62 have come */
    double cpu_ppm;       /* error of the board's resonator */
    double boot;          /* 1: a boot loader runs after each opening */
    double speed;         /* simulated per real second at most; 0: as fast as it goes */
    double seconds;       /* simulated time after which the rig ends by itself */
    double cs_pull;       /* level of chip select while the board does not drive it */
    double phase_us;      /* of the boot loader's sampling clock */
    double spi_halves;    /* half periods of the clock from the write of SPDR to SPIF */
} option = {.baud = 500000, .latency_ms = 1, .boot = 1, .speed = 1, .seconds = 600, .cs_pull = 1, .spi_halves = 16};

/* -- state ---------------------------------------------------------------------------------------------------- */

static avr_t *avr;
static chip_t *chip;
static boot_t boot;
static elf_firmware_t firmware;
static ps_t epoch_ps, cycle_ps;
static volatile int64_t *shared_ps;
static int pty = -1, watch = -1; /* the pty's master, and who opens its slave */
static FILE *out; /* stdout; simavr chats on that of the C library */

static avr_uart_t *uart;
static avr_int_vector_t *int0;
static line_t to_board, to_host;
static receiver_t board_ear, host_ear;
static struct {
    uint8_t fifo[2], error[2], held, held_error;
    int count, holding, overrun;
    int shifting, waiting; /* transmitter: a byte in the shifter, one behind it */
    uint8_t next;
    ps_t start;            /* of the byte being received */
    int receiving;
} serial;
static struct { int busy, half, halves_left; uint8_t out, in, received; int seen; } spi;
static int level_cs = 1, level_sck = 1, level_mosi, level_rst = 1, level_dio = -1;

static uint8_t usb[1 << 20]; /* bytes that the adapter holds, then those that the pty has not taken */
static size_t usb_count, usb_ready;
static ps_t usb_since;

static struct { uint64_t from_host, to_host, heard, edges; uint32_t openings, board_framing, board_overruns, host_framing; } seen;

static avr_cycle_count_t cycles_at(ps_t at)
{
    ps_t since = at - epoch_ps;
    return since <= 0 ? 0 : (avr_cycle_count_t)((since + cycle_ps - 1) / cycle_ps);
}

static ps_t now_ps(void)
{
    return epoch_ps + (ps_t)avr->cycle * cycle_ps;
}

static void at_time(ps_t at, avr_cycle_timer_t call)
{
    avr_cycle_count_t cycle = cycles_at(at);
    avr_cycle_timer_register(avr, cycle > avr->cycle ? cycle - avr->cycle : 1, call, NULL);
}

/* -- capture --------------------------------------------------------------------------------------------------- */

static FILE *vcd;
static void fail(const char *what);

static void open_vcd(const char *path)
{
    vcd = fopen(path, "w");
    if (vcd == NULL) {
        fail("vcd: cannot be written");
    }
    fprintf(vcd, "$timescale 1 ns $end\n$scope module pins $end\n$var wire 1 c cs $end\n$var wire 1 k sclk $end\n"
                 "$var wire 1 o mosi $end\n$var wire 1 i miso $end\n$var wire 1 d dio1 $end\n$upscope $end\n"
                 "$enddefinitions $end\n#0\n1c\n1k\n0o\n1i\n1d\n");
}

static void capture(ps_t now, char wire, int level)
{
    static ps_t last = 0;
    if (vcd == NULL) {
        return;
    }
    if (now / 1000 != last) {
        last = now / 1000;
        fprintf(vcd, "#%lld\n", (long long)last);
    }
    fprintf(vcd, "%d%c\n", level != 0, wire);
}

/* -- pins ------------------------------------------------------------------------------------------------------ */

static avr_cycle_count_t dio_timer(avr_t *mcu, avr_cycle_count_t when, void *param);

static void follow_dio(ps_t now)
{
    int level = chip_dio(chip, now, 1);
    if (level != HIGH_Z && level != level_dio) {
        if (level_dio != -1) {
            seen.edges++;
        }
        level_dio = level;
        capture(now, 'd', level);
        avr_raise_irq(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('D'), 2), (uint32_t)level);
    }
    ps_t next = chip_next_event(chip, now);
    if (next != NEVER) {
        at_time(next, dio_timer);
    }
}

static avr_cycle_count_t dio_timer(avr_t *mcu, avr_cycle_count_t when, void *param)
{
    (void)mcu, (void)when, (void)param;
    follow_dio(now_ps());
    return 0;
}

static void set_cs(ps_t now, int level)
{
    if (level != level_cs) {
        level_cs = level;
        capture(now, 'c', level);
        chip_cs(chip, now, level);
        if (level) {
            follow_dio(now); /* a write may have changed the lines */
        }
    }
}

static void set_sck(ps_t now, int level)
{
    if (level != level_sck) {
        level_sck = level;
        capture(now, 'k', level);
        chip_sck(chip, now, level);
    }
}

static void set_mosi(ps_t now, int level)
{
    if (level != level_mosi) {
        level_mosi = level;
        capture(now, 'o', level);
        chip_mosi(chip, now, level);
    }
}

/* Levels that port B makes of its registers and what hangs on them. */
static void follow_port(void)
{
    ps_t now = now_ps();
    uint8_t port = avr->data[R_PORTB], direction = avr->data[R_DDRB], control = avr->data[R_SPCR];
    int by_spi = (control & SPE) && (control & MSTR);
    int rst = direction & (1 << RST) ? (port >> RST) & 1 : 1; /* a pull-up */
    if (!by_spi) {
        set_sck(now, direction & (1 << SCK) ? (port >> SCK) & 1 : 1);
        set_mosi(now, direction & (1 << MOSI) ? (port >> MOSI) & 1 : 1);
    } else if (!spi.busy) {
        set_sck(now, (control & CPOL) != 0);
    }
    set_cs(now, direction & (1 << CS) ? (port >> CS) & 1 : option.cs_pull != 0);
    if (rst != level_rst) {
        level_rst = rst;
        chip_rst(chip, now, rst);
        follow_dio(now);
    }
}

static struct { avr_io_write_t call; void *param; } port_write[2];

static void write_port(avr_t *mcu, avr_io_addr_t address, uint8_t value, void *param)
{
    int which = address == R_PORTB;
    (void)param;
    if (port_write[which].call) {
        port_write[which].call(mcu, address, value, port_write[which].param);
    } else {
        mcu->data[address] = value;
    }
    follow_port();
}

/* -- SPI master -------------------------------------------------------------------------------------------------- */

static avr_cycle_count_t spi_edge(avr_t *mcu, avr_cycle_count_t when, void *param)
{
    ps_t now = epoch_ps + (ps_t)when * cycle_ps;
    uint8_t control = mcu->data[R_SPCR];
    int idle = (control & CPOL) != 0, late = (control & CPHA) != 0;
    int done = (int)option.spi_halves - spi.halves_left, leading = done % 2 == 0;
    (void)param;
    if (done < 16) {
        int bit = control & DORD ? done / 2 : 7 - done / 2;
        if (leading == late) { /* the edge that sets data up */
            set_mosi(now, (spi.out >> bit) & 1);
        }
        if (leading != late) { /* the one that samples; a wire that nothing drives reads high */
            int miso = chip_miso(chip, now) != 0;
            capture(now, 'i', miso);
            spi.in |= (uint8_t)(miso << bit);
        }
        set_sck(now, leading ? !idle : idle);
        if (!late && !leading && done < 15) {
            int next = control & DORD ? done / 2 + 1 : 6 - done / 2;
            set_mosi(now, (spi.out >> next) & 1);
        }
    }
    if (--spi.halves_left == 0) {
        spi.busy = 0;
        spi.received = spi.in;
        mcu->data[R_SPSR] |= SPIF;
        return 0;
    }
    return when + (avr_cycle_count_t)spi.half;
}

static void spi_touch(avr_t *mcu) /* SPIF goes where SPDR is used after SPSR was read with it set */
{
    if (spi.seen) {
        mcu->data[R_SPSR] &= (uint8_t)~(SPIF | WCOL);
        spi.seen = 0;
    }
}

static void write_spdr(avr_t *mcu, avr_io_addr_t address, uint8_t value, void *param)
{
    static const uint8_t dividers[] = {4, 16, 64, 128};
    uint8_t control = mcu->data[R_SPCR];
    (void)address, (void)param;
    spi_touch(mcu);
    if (!(control & SPE) || !(control & MSTR)) {
        return;
    }
    if (spi.busy) {
        mcu->data[R_SPSR] |= WCOL;
        return;
    }
    spi.busy = 1;
    spi.out = value;
    spi.in = 0;
    spi.half = dividers[control & 3] / (mcu->data[R_SPSR] & SPI2X ? 2 : 1) / 2;
    spi.halves_left = (int)option.spi_halves;
    avr_cycle_timer_register(mcu, (avr_cycle_count_t)spi.half, spi_edge, NULL);
}

static uint8_t read_spdr(avr_t *mcu, avr_io_addr_t address, void *param)
{
    (void)address, (void)param;
    spi_touch(mcu);
    return spi.received;
}

static uint8_t read_spsr(avr_t *mcu, avr_io_addr_t address, void *param)
{
    (void)param;
    spi.seen |= mcu->data[address] & SPIF;
    return mcu->data[address];
}

static void write_spsr(avr_t *mcu, avr_io_addr_t address, uint8_t value, void *param)
{
    (void)param;
    mcu->data[address] = (uint8_t)((mcu->data[address] & ~SPI2X) | (value & SPI2X));
}

static void write_spcr(avr_t *mcu, avr_io_addr_t address, uint8_t value, void *param)
{
    (void)param;
    mcu->data[address] = value;
    follow_port();
}

/* -- UART ---------------------------------------------------------------------------------------------------------- */

static avr_cycle_count_t ear_start(avr_t *mcu, avr_cycle_count_t when, void *param);
static avr_cycle_count_t ear_done(avr_t *mcu, avr_cycle_count_t when, void *param);
static avr_cycle_count_t sent_byte(avr_t *mcu, avr_cycle_count_t when, void *param);

static int bit_cycles(void)
{
    int divisor = (avr->data[R_UBRRL] | (avr->data[R_UBRRH] & 0xF) << 8) + 1;
    return divisor * (avr->data[R_UCSRA] & U2X ? 8 : 16);
}

static void listen(void)
{
    ps_t done;
    if (!serial.receiving && (avr->data[R_UCSRB] & RXEN) && board_ear.tick &&
        receiver_next(&board_ear, &to_board, &serial.start, &done)) {
        serial.receiving = 1;
        at_time(serial.start, ear_start);
    }
}

static void show_received(void)
{
    uint8_t flags = (uint8_t)(avr->data[R_UCSRA] & ~(RXC | FE | DOR));
    if (serial.count) {
        flags |= RXC | (serial.error[0] ? FE : 0);
    }
    avr->data[R_UCSRA] = (uint8_t)(flags | (serial.overrun ? DOR : 0));
    if (serial.count) {
        avr_raise_interrupt(avr, &uart->rxc);
    } else {
        avr_clear_interrupt(avr, &uart->rxc);
    }
}

static avr_cycle_count_t ear_start(avr_t *mcu, avr_cycle_count_t when, void *param)
{
    (void)mcu, (void)when, (void)param;
    if (serial.holding) { /* two in the buffer and one behind it: that one is lost */
        serial.holding = 0;
        serial.overrun = 1;
        seen.board_overruns++;
        show_received();
    }
    at_time(serial.start + (9 * board_ear.per_bit + board_ear.per_bit / 2 + 1) * board_ear.tick, ear_done);
    return 0;
}

static avr_cycle_count_t ear_done(avr_t *mcu, avr_cycle_count_t when, void *param)
{
    uint8_t byte = 0;
    int error = 0;
    (void)mcu, (void)when, (void)param;
    if (receiver_take(&board_ear, &to_board, serial.start, &byte, &error)) {
        seen.board_framing += (uint32_t)error;
        if (serial.count < 2) {
            serial.fifo[serial.count] = byte;
            serial.error[serial.count++] = (uint8_t)error;
        } else {
            serial.holding = 1;
            serial.held = byte;
            serial.held_error = (uint8_t)error;
        }
        show_received();
    }
    line_forget(&to_board, board_ear.from - 2 * board_ear.tick);
    serial.receiving = 0;
    listen();
    return 0;
}

static uint8_t read_udr(avr_t *mcu, avr_io_addr_t address, void *param)
{
    uint8_t byte = serial.fifo[0];
    (void)mcu, (void)address, (void)param;
    if (serial.count) {
        serial.fifo[0] = serial.fifo[1];
        serial.error[0] = serial.error[1];
        serial.count--;
        if (serial.holding) {
            serial.fifo[serial.count] = serial.held;
            serial.error[serial.count++] = serial.held_error;
            serial.holding = 0;
        }
    }
    serial.overrun = 0;
    avr_clear_interrupt(avr, &uart->rxc);
    show_received();
    return byte;
}

static void show_empty(int empty)
{
    if (empty) {
        avr->data[R_UCSRA] |= UDRE;
        avr_raise_interrupt(avr, &uart->udrc);
    } else {
        avr->data[R_UCSRA] &= (uint8_t)~UDRE;
        avr_clear_interrupt(avr, &uart->udrc);
    }
}

static void shift_out(ps_t now, uint8_t byte)
{
    serial.shifting = 1;
    at_time(line_send(&to_host, now, bit_cycles() * cycle_ps, byte), sent_byte);
}

static avr_cycle_count_t sent_byte(avr_t *mcu, avr_cycle_count_t when, void *param)
{
    ps_t now = epoch_ps + (ps_t)when * cycle_ps;
    (void)mcu, (void)param;
    serial.shifting = 0;
    if (serial.waiting) {
        serial.waiting = 0;
        shift_out(now, serial.next);
        show_empty(1);
    } else {
        avr->data[R_UCSRA] |= TXC;
    }
    return 0;
}

static void write_udr(avr_t *mcu, avr_io_addr_t address, uint8_t value, void *param)
{
    (void)address, (void)param;
    if (!(mcu->data[R_UCSRB] & TXEN) || serial.waiting) {
        return;
    }
    if (serial.shifting) {
        serial.waiting = 1;
        serial.next = value;
        show_empty(0);
    } else {
        shift_out(now_ps(), value);
        avr_clear_interrupt(avr, &uart->udrc);
        show_empty(1);
    }
}

static void write_ucsra(avr_t *mcu, avr_io_addr_t address, uint8_t value, void *param)
{
    uint8_t keep = RXC | UDRE | FE | DOR;
    (void)param;
    mcu->data[address] = (uint8_t)((mcu->data[address] & keep) | (value & U2X) | (mcu->data[address] & TXC & ~value));
}

static void write_ucsrb(avr_t *mcu, avr_io_addr_t address, uint8_t value, void *param)
{
    int was_on = mcu->data[address] & RXEN;
    (void)param;
    mcu->data[address] = value;
    if ((value & RXEN) && !was_on) {
        int per_bit = mcu->data[R_UCSRA] & U2X ? 8 : 16;
        receiver_begin(&board_ear, now_ps(), bit_cycles() / per_bit * cycle_ps, now_ps(), per_bit);
        listen();
    }
    if (serial.count) {
        avr_raise_interrupt(avr, &uart->rxc);
    }
    if (mcu->data[R_UCSRA] & UDRE) {
        avr_raise_interrupt(avr, &uart->udrc);
    }
}

static void write_eifr(avr_t *mcu, avr_io_addr_t address, uint8_t value, void *param)
{
    (void)param;
    if (value & 1) {
        avr_clear_interrupt(mcu, int0);
    }
    mcu->data[address] &= (uint8_t)~value;
}

/* -- the board ------------------------------------------------------------------------------------------------------ */

static void hook_write(int address, avr_io_write_t call)
{
    avr->io[address - 32].w.c = call;
    avr->io[address - 32].w.param = NULL;
}

static void hook_read(int address, avr_io_read_t call)
{
    avr->io[address - 32].r.c = call;
    avr->io[address - 32].r.param = NULL;
}

static void fail(const char *what)
{
    fprintf(stderr, "rig: %s\n", what);
    exit(1);
}

/* The application, from reset; the board before it is gone. */
static void start_application(ps_t now)
{
    avr_io_t *io;
    int k;
    if (avr != NULL) {
        avr_terminate(avr);
        free(avr);
    }
    avr = avr_make_mcu_by_name("atmega328p");
    if (avr == NULL || avr_init(avr) != 0) {
        fail("simavr has no atmega328p");
    }
    avr->frequency = F_CPU;
    avr->log = LOG_ERROR;
    avr_load_firmware(avr, &firmware);
    uart = NULL;
    int0 = NULL;
    for (io = avr->io_port; io != NULL; io = io->next) {
        if (strcmp(io->kind, "uart") == 0) {
            uart = (avr_uart_t *)io;
        } else if (strcmp(io->kind, "extint") == 0) {
            int0 = &((avr_extint_t *)io)->eint[0].vector;
        }
    }
    if (uart == NULL || int0 == NULL) {
        fail("simavr's atmega328p has no UART or no INT0");
    }
    avr_extint_set_strict_lvl_trig(avr, 0, 0);
    for (k = 0; k < 2; k++) {
        int address = k ? R_PORTB : R_DDRB;
        port_write[k].call = avr->io[address - 32].w.c;
        port_write[k].param = avr->io[address - 32].w.param;
        hook_write(address, write_port);
    }
    hook_write(R_SPCR, write_spcr);
    hook_write(R_SPSR, write_spsr);
    hook_write(R_SPDR, write_spdr);
    hook_read(R_SPSR, read_spsr);
    hook_read(R_SPDR, read_spdr);
    hook_write(R_UCSRA, write_ucsra);
    hook_write(R_UCSRB, write_ucsrb);
    hook_write(R_UDR, write_udr);
    hook_read(R_UDR, read_udr);
    hook_read(R_UCSRA, NULL);
    hook_write(R_EIFR, write_eifr);
    memset(&serial, 0, sizeof serial);
    memset(&spi, 0, sizeof spi);
    board_ear.tick = 0;
    avr->data[R_UCSRA] = UDRE;
    epoch_ps = now - (ps_t)avr->cycle * cycle_ps;
    level_dio = -1;
    follow_port();
    follow_dio(now);
}

/* -- the host's end --------------------------------------------------------------------------------------------------- */

static ps_t host_bit(void)
{
    return (ps_t)(1e12 / option.baud);
}

static void host_listens(ps_t now)
{
    ps_t start, done;
    while (receiver_next(&host_ear, &to_host, &start, &done) && done <= now) {
        uint8_t byte = 0;
        int error = 0;
        if (receiver_take(&host_ear, &to_host, start, &byte, &error)) {
            seen.host_framing += (uint32_t)error;
            seen.heard++;
            if (!error && usb_count < sizeof usb) {
                if (usb_count == usb_ready) {
                    usb_since = done;
                }
                usb[usb_count++] = byte;
                if (usb_count - usb_ready >= 62) {
                    usb_ready = usb_count;
                }
            }
        }
        line_forget(&to_host, host_ear.from - 2 * host_ear.tick);
    }
    if (usb_count > usb_ready && now - usb_since >= (ps_t)(option.latency_ms * 1e9)) {
        usb_ready = usb_count;
    }
    while (usb_ready) {
        ssize_t n = write(pty, usb, usb_ready);
        if (n <= 0) {
            break;
        }
        seen.to_host += (uint64_t)n;
        memmove(usb, usb + n, usb_count - (size_t)n);
        usb_count -= (size_t)n;
        usb_ready -= (size_t)n;
    }
}

/* Bytes from the pty onto the line; 0 where nobody has it open. */
static int host_sends(ps_t now)
{
    uint8_t buffer[4096];
    struct pollfd ask = {.fd = pty, .events = POLLIN};
    ssize_t n, k;
    if (poll(&ask, 1, 0) < 0) {
        return 1;
    }
    if (ask.revents & POLLIN) {
        n = read(pty, buffer, sizeof buffer);
        for (k = 0; k < n; k++) {
            line_send(&to_board, now, host_bit(), buffer[k]);
        }
        if (n > 0) {
            seen.from_host += (uint64_t)n;
        }
    }
    return !(ask.revents & POLLHUP);
}

/* 1 where the pty was opened since the last question, be it closed again by now. */
static int was_opened(void)
{
    _Alignas(struct inotify_event) char events[4096];
    ssize_t n = read(watch, events, sizeof events);
    char *at = events;
    int opened = 0;
    while (n > 0 && at < events + n) {
        const struct inotify_event *event = (const struct inotify_event *)at;
        opened |= (event->mask & IN_OPEN) != 0;
        at += sizeof *event + event->len;
    }
    return opened;
}

static int open_pty(void)
{
    struct termios raw;
    int slave;
    const char *name;
    pty = posix_openpt(O_RDWR | O_NOCTTY | O_NONBLOCK);
    if (pty < 0 || grantpt(pty) || unlockpt(pty) || (name = ptsname(pty)) == NULL) {
        return 0;
    }
    slave = open(name, O_RDWR | O_NOCTTY);
    if (slave < 0 || tcgetattr(slave, &raw)) {
        return 0;
    }
    cfmakeraw(&raw);
    tcsetattr(slave, TCSANOW, &raw);
    close(slave); /* from now on the kernel tells whether somebody has it open */
    watch = inotify_init1(IN_NONBLOCK);
    if (watch < 0 || inotify_add_watch(watch, name, IN_OPEN) < 0) {
        return 0;
    }
    fprintf(out, "%s\n", name);
    fflush(out);
    return 1;
}

/* -- reports ------------------------------------------------------------------------------------------------------------ */

static const char *const input_names[INPUTS] = {"supply", "gyro_x", "gyro_y", "gyro_z", "accl_x", "accl_y", "accl_z",
                                                "temp_x", "temp_y", "temp_z", "aux"};

static void report(ps_t now)
{
    static const char *const extremes[] = {"stall", "period", "sclk", "select"};
    ps_t at, value;
    int kind;
    uint32_t k;
    fprintf(out, "{\"time_s\": %.9f, \"frames\": %llu, \"updates\": %llu, \"edges\": %llu, \"openings\": %u", now * 1e-12,
           (unsigned long long)chip_frame_count(chip), (unsigned long long)chip_update_count(chip),
           (unsigned long long)seen.edges, seen.openings);
    fprintf(out, ", \"from_host\": %llu, \"to_host\": %llu, \"heard\": %llu, \"board_framing\": %u, \"board_overruns\": %u, \"host_framing\": %u",
           (unsigned long long)seen.from_host, (unsigned long long)seen.to_host, (unsigned long long)seen.heard, seen.board_framing,
           seen.board_overruns, seen.host_framing);
    fprintf(out, ", \"boot\": {\"bytes\": %u, \"framing_errors\": %u, \"overruns\": %u, \"commands\": %u, \"page_erases\": %u, "
           "\"page_writes\": %u}",
           boot.counts.bytes, boot.counts.framing_errors, boot.counts.overruns, boot.counts.commands,
           boot.counts.page_erases, boot.counts.page_writes);
    fprintf(out, ", \"extremes_us\": {");
    for (k = 0; k < 4; k++) {
        value = chip_extreme(chip, extremes[k]);
        fprintf(out, value == NEVER ? "%s\"%s\": null" : "%s\"%s\": %.4f", k ? ", " : "", extremes[k], value * 1e-6);
    }
    fprintf(out, "}, \"violations\": {");
    for (kind = 0; kind < V_KINDS; kind++) {
        fprintf(out, "%s\"%s\": %u", kind ? ", " : "", chip_violation_name(kind), chip_violations(chip, kind));
    }
    fprintf(out, "}, \"log\": [");
    for (k = 0; k < 20 && (kind = chip_violation(chip, k, &at, &value)) >= 0; k++) {
        fprintf(out, "%s[\"%s\", %.9f, %.4f]", k ? ", " : "", chip_violation_name(kind), at * 1e-12, value * 1e-6);
    }
    fprintf(out, "]}\n");
}

/* One line of stdin; 0 for quit. */
static int obey(char *line, ps_t now)
{
    char word[32] = "", name[64] = "";
    double value = 0;
    int n = sscanf(line, "%31s %63s %lf", word, name, &value), k, good = 0;
    if (n >= 1 && strcmp(word, "quit") == 0) {
        return 0;
    }
    if (n >= 1 && strcmp(word, "report") == 0) {
        report(now);
        if (vcd) {
            fflush(vcd);
        }
    } else if (n >= 1 && strcmp(word, "forget") == 0) {
        chip_forget_extremes(chip);
        fprintf(out, "done\n");
    } else {
        if (n == 3 && strcmp(word, "set") == 0) {
            good = chip_set(chip, name, value);
        } else if (n == 3 && strcmp(word, "input") == 0) {
            for (k = 0; k < INPUTS; k++) {
                if (strcmp(name, input_names[k]) == 0) {
                    chip_input(chip, now, k, value);
                    good = 1;
                }
            }
        }
        fprintf(out, good ? "done\n" : "error: not understood\n");
    }
    fflush(out);
    return 1;
}

static int obey_all(ps_t now, int wait_ms)
{
    static char text[512];
    static size_t have;
    struct pollfd ask = {.fd = 0, .events = POLLIN};
    char *end;
    if (poll(&ask, 1, wait_ms) <= 0) {
        return 1;
    }
    ssize_t n = read(0, text + have, sizeof text - 1 - have);
    if (n <= 0) {
        return 0; /* whoever started the rig is gone */
    }
    have += (size_t)n;
    text[have] = 0;
    while ((end = strchr(text, '\n')) != NULL) {
        *end = 0;
        if (!obey(text, now)) {
            return 0;
        }
        have -= (size_t)(end + 1 - text);
        memmove(text, end + 1, have + 1);
    }
    return have < sizeof text - 1;
}

/* -- time ----------------------------------------------------------------------------------------------------------------- */

static double wall_s(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + now.tv_nsec * 1e-9;
}

/* Waits where the board is ahead of the wall clock; where it is behind, that time is given up. */
static void keep_pace(ps_t now, double *wall_zero)
{
    double ahead;
    if (option.speed <= 0) {
        return;
    }
    ahead = *wall_zero + now * 1e-12 / option.speed - wall_s();
    if (ahead > 0.001) {
        usleep((useconds_t)(ahead * 1e6));
    } else if (ahead < -0.005) {
        *wall_zero -= ahead;
    }
}

/* The boot loader has the board: no application, its LED is the SPI clock's pin. */
static void run_boot(ps_t now)
{
    ps_t blink = boot.options.blink / 6, begun = boot.reads - boot.options.blink;
    if (now >= begun && now < boot.reads) {
        set_sck(now, (int)((now - begun) / blink) % 2);
    } else {
        set_sck(now, 1); /* not driven: a pull-up */
    }
    set_cs(now, option.cs_pull != 0);
}

static int take_option(const char *text)
{
    static const struct { const char *name; double *value; } numbers[] = {
        {"baud", &option.baud}, {"latency_ms", &option.latency_ms}, {"cpu_ppm", &option.cpu_ppm}, {"boot", &option.boot},
        {"speed", &option.speed}, {"seconds", &option.seconds}, {"cs_pull", &option.cs_pull},
        {"phase_us", &option.phase_us}, {"spi_halves", &option.spi_halves},
    };
    const char *equals = strchr(text, '=');
    char name[64], *end;
    size_t k;
    double value;
    if (equals == NULL || (size_t)(equals - text) >= sizeof name) {
        return 0;
    }
    memcpy(name, text, (size_t)(equals - text));
    name[equals - text] = 0;
    if (strcmp(name, "elf") == 0) {
        option.elf = equals + 1;
        return 1;
    }
    if (strcmp(name, "vcd") == 0) {
        open_vcd(equals + 1);
        return 1;
    }
    if (strcmp(name, "clock") == 0) {
        option.clock = equals + 1;
        return 1;
    }
    value = strtod(equals + 1, &end);
    if (end == equals + 1 || *end) {
        return 0;
    }
    for (k = 0; k < sizeof numbers / sizeof numbers[0]; k++) {
        if (strcmp(name, numbers[k].name) == 0) {
            *numbers[k].value = value;
            return 1;
        }
    }
    return chip_set(chip, name, value);
}

int main(int argc, char **argv)
{
    ps_t now = 0;
    double wall_zero = 0;
    int k, booting = 0;
    static int64_t own_clock;
    out = fdopen(dup(1), "w");
    if (out == NULL || freopen("/dev/null", "w", stdout) == NULL) {
        fail("no stdout");
    }
    chip = chip_new();
    for (k = 1; k < argc; k++) {
        if (chip == NULL || !take_option(argv[k])) {
            fprintf(stderr, "rig: no option or parameter '%s'\n", argv[k]);
            return 2;
        }
    }
    if (option.elf == NULL || elf_read_firmware(option.elf, &firmware) != 0) {
        fprintf(stderr, "rig: elf=FILE: no such firmware\n");
        return 2;
    }
    prctl(PR_SET_PDEATHSIG, SIGKILL);
    cycle_ps = (ps_t)(62500.0 / (1.0 + option.cpu_ppm * 1e-6) + 0.5);
    shared_ps = &own_clock;
    if (option.clock) {
        int file = open(option.clock, O_RDWR | O_CREAT, 0600);
        if (file < 0 || ftruncate(file, 8) ||
            (shared_ps = mmap(NULL, 8, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0)) == MAP_FAILED) {
            fail("clock=FILE cannot be mapped");
        }
    }
    if (!open_pty()) {
        fail("no pty");
    }
    chip_power_on(chip, 0);
    host_ear.tick = 0;
    while (now < (ps_t)(option.seconds * 1e12)) {
        if (was_opened()) {
            seen.openings++;
            usb_count = usb_ready = 0;
            line_clear(&to_host);
            receiver_begin(&host_ear, now, host_bit() / 16, now, 16);
            wall_zero = wall_s() - (option.speed > 0 ? now * 1e-12 / option.speed : 0);
            if (option.boot != 0) {
                struct boot_options options = boot_uno;
                options.phase = (ps_t)(option.phase_us * 1e6);
                boot_begin(&boot, now, &options, &to_host);
                booting = 1;
            } else if (avr == NULL) {
                start_application(now);
            }
        }
        if (!host_sends(now) || (avr == NULL && !booting)) { /* nobody has it open: the board stands still */
            if (!obey_all(now, 5)) {
                return 0;
            }
            continue;
        }
        if (!obey_all(now, 0)) {
            return 0;
        }
        if (booting) {
            now += SLICE_PS;
            run_boot(now);
            if (!boot_run(&boot, &to_board, now)) {
                booting = 0;
                set_sck(now, 1);
                start_application(now);
            }
        } else {
            ps_t until = now + SLICE_PS;
            listen();
            while (now < until) {
                int state;
                avr_cycle_count_t left = cycles_at(until) - avr->cycle;
                avr->run_cycle_limit = left > 0 ? left : 1;
                state = avr_run(avr);
                if (state == cpu_Done || state == cpu_Crashed) {
                    fail("the firmware crashed");
                }
                now = now_ps();
            }
        }
        host_listens(now);
        __atomic_store_n(shared_ps, now, __ATOMIC_RELEASE);
        keep_pace(now, &wall_zero);
    }
    fprintf(stderr, "rig: %g simulated seconds are over\n", option.seconds);
    return 3;
}
