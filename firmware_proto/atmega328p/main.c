/* Arduino Uno or Nano: ATmega328P at 16 MHz. Pins and wiring: README.md.
 *
 * Timer 1 counts half microseconds for ever. The times of chip select are taken from it after each edge
 * was made, so whatever interrupts make a frame longer or later, never shorter or earlier.
 */
#include <avr/eeprom.h>
#include <avr/cpufunc.h>
#include <avr/interrupt.h>
#include <avr/io.h>
#include <string.h>

#include "gonio_board.h"
#include "gonio_core.h"

#ifndef BAUD
#define BAUD GP_BAUD
#endif
#define DIVISOR (F_CPU / 8ul / BAUD - 1ul)
#if F_CPU != 16000000ul || (DIVISOR + 1ul) * BAUD * 8ul != F_CPU
#error "16 MHz, and a baud rate that divides 2 MHz"
#endif

#define CS PB2
#define MOSI PB3
#define SCK PB5
#define RST PB1
#define DATA_READY PD2

#define TICKS_A_US 2u
#define OVERFLOW_US 32768ul
/* SLP_CNT wants CS high within 10 us after the 16th clock: no interrupt begins in the last 16 us before it, which is
 * longer than any of them takes. At 500 kHz and above that is the whole last byte. The UART's receiver holds two
 * bytes, 20 us at 1 Mbaud. */
#define QUIET_TICKS 32u

#define BOARD "atmega328p"
#define SERIAL_ADDRESS ((const uint8_t *)0)
#define SERIAL_ROOM 12u

#define RECEIVE_RING 64u /* a power of two */

const uint16_t board_capabilities = GP_CAP_DATA_READY | GP_CAP_HARD_RESET;

/* 2 MHz is left out: it is the chip's limit, and resonators are off by 0.5 %. */
const uint32_t board_clocks_hz[GP_CLOCKS] = {1000000ul, 500000ul, 250000ul, 125000ul, 0ul, 0ul};
/* SPR1, SPR0 and SPI2X (bit 2) of these clocks. */
static const uint8_t dividers[] = {1u, 6u, 2u, 3u};

static volatile uint32_t base_us;
static uint16_t started, risen, period_ticks, stall_ticks, byte_ticks;

static volatile uint8_t received[RECEIVE_RING];
static volatile uint8_t received_head, received_tail;
static volatile uint16_t overruns;
static uint8_t sending[256];
static volatile uint8_t sending_head, sending_tail;
static uint8_t sending_end; /* head, once the bytes behind it may go */

/* -- time ------------------------------------------------------------------------------------------ */

/* TCNT1 is read through a byte shared with the interrupts. */
static uint16_t ticks(void)
{
    uint16_t now;
    uint8_t flags = SREG;
    cli();
    now = TCNT1;
    SREG = flags;
    return now;
}

ISR(TIMER1_OVF_vect)
{
    base_us += OVERFLOW_US;
}

uint32_t board_now_us(void)
{
    uint32_t now;
    uint16_t count;
    uint8_t flags = SREG;
    cli();
    count = TCNT1;
    now = base_us;
    if ((TIFR1 & (1u << TOV1)) != 0u && count < 0x8000u) {
        now += OVERFLOW_US; /* it has just wrapped, its interrupt waits */
    }
    SREG = flags;
    return now + count / TICKS_A_US;
}

void board_lock(void)
{
    cli();
}

void board_unlock(void)
{
    sei();
}

/* -- frames ------------------------------------------------------------------------------------------ */

void board_set_timing(uint8_t clock, uint16_t stall_us, uint16_t period_us)
{
    uint8_t divider = dividers[clock];
    SPCR = (uint8_t)((1u << SPE) | (1u << MSTR) | (1u << CPOL) | (1u << CPHA) | (divider & 3u));
    SPSR = (divider & 4u) != 0u ? 1u << SPI2X : 0u;
    byte_ticks = (uint16_t)(8ul * TICKS_A_US * 1000000ul / board_clocks_hz[clock]);
    stall_ticks = (uint16_t)(stall_us * TICKS_A_US + 1u); /* a count of n + 1 is n ticks at least */
    period_ticks = (uint16_t)(period_us * TICKS_A_US + 1u);
}

uint16_t board_frame(uint16_t word)
{
    uint16_t begun, reply;
    while ((uint16_t)(ticks() - risen) < stall_ticks || (uint16_t)(ticks() - started) < period_ticks) {
    }
    PORTB &= (uint8_t)~(1u << CS);
    SPDR = (uint8_t)(word >> 8);
    started = ticks();
    while ((SPSR & (1u << SPIF)) == 0u || (uint16_t)(ticks() - started) <= byte_ticks) {
        /* the clock stays high for its half period between the bytes too */
    }
    reply = (uint16_t)((uint16_t)SPDR << 8);
    cli();
    SPDR = (uint8_t)word;
    begun = TCNT1;
    while ((uint16_t)(TCNT1 - begun + QUIET_TICKS) < byte_ticks) {
        sei(); /* one interrupt, no more: the instruction behind its return is cli */
        _NOP();
        cli();
    }
    while ((SPSR & (1u << SPIF)) == 0u) {
    }
    PORTB |= 1u << CS;
    risen = TCNT1;
    sei();
    return reply | SPDR;
}

void board_reset_chip(uint16_t low_us)
{
    uint32_t from = board_now_us();
    DDRB |= 1u << RST; /* open drain: the port's bit stays 0 */
    while (board_now_us() - from <= low_us) {
    }
    DDRB &= (uint8_t)~(1u << RST);
}

/* -- data-ready ---------------------------------------------------------------------------------------- */

void board_select_edge(uint8_t falling)
{
    uint8_t flags = SREG;
    cli();
    EICRA = falling != 0u ? 1u << ISC01 : (1u << ISC01) | (1u << ISC00);
    EIFR = 1u << INTF0; /* the change itself is no edge */
    SREG = flags;
}

ISR(INT0_vect)
{
    gonio_on_edge(board_now_us());
}

/* -- serial port --------------------------------------------------------------------------------------- */

ISR(USART_RX_vect)
{
    uint8_t flags;
    while (((flags = UCSR0A) & (1u << RXC0)) != 0u) { /* two bytes may wait where interrupts were off */
        uint8_t byte = UDR0;
        uint8_t next = (received_head + 1u) & (RECEIVE_RING - 1u);
        if ((flags & (1u << DOR0)) != 0u) {
            overruns++;
        }
        if (next == received_tail) {
            overruns++;
        } else {
            received[received_head] = byte;
            received_head = next;
        }
    }
}

ISR(USART_UDRE_vect)
{
    UDR0 = sending[sending_tail++];
    if (sending_tail == sending_head) {
        UCSR0B &= (uint8_t)~(1u << UDRIE0);
    }
}

uint8_t board_receive(uint8_t *byte)
{
    uint8_t tail = received_tail;
    if (tail == received_head) {
        return 0;
    }
    *byte = received[tail];
    received_tail = (tail + 1u) & (RECEIVE_RING - 1u);
    return 1;
}

uint16_t board_receive_overruns(void)
{
    uint16_t count;
    cli();
    count = overruns;
    sei();
    return count;
}

uint16_t board_send_room(void)
{
    return (uint8_t)(sending_tail - sending_end - 1u);
}

void board_send(uint8_t byte)
{
    sending[sending_end++] = byte;
}

void board_send_now(void)
{
    cli(); /* which is a barrier as well: the bytes are in memory before the head moves */
    sending_head = sending_end;
    UCSR0B |= 1u << UDRIE0;
    sei();
}

/* -- name ---------------------------------------------------------------------------------------------- */

uint8_t board_name(uint8_t *text, uint8_t room)
{
    uint8_t length = sizeof BOARD - 1u;
    uint8_t k;
    (void)room; /* BOARD, a blank and SERIAL_ROOM are 23 */
    memcpy(text, BOARD, length);
    for (k = 0; k < SERIAL_ROOM; k++) {
        uint8_t letter = eeprom_read_byte(SERIAL_ADDRESS + k);
        if (letter <= ' ' || letter > '~') {
            break; /* an empty EEPROM holds 0xFF */
        }
        if (k == 0u) {
            text[length++] = ' ';
        }
        text[length++] = letter;
    }
    return length;
}

int main(void)
{
    PORTB = 1u << CS; /* high before it becomes an output */
    DDRB = (1u << CS) | (1u << MOSI) | (1u << SCK);
    PORTD = 1u << DATA_READY; /* pull-up: without its wire the input would take up noise */
    TCCR1A = 0;
    TCCR1B = 1u << CS11; /* 16 MHz / 8 */
    TIMSK1 = 1u << TOIE1;
    UBRR0 = DIVISOR;
    UCSR0A = 1u << U2X0;
    UCSR0C = (1u << UCSZ01) | (1u << UCSZ00);
    UCSR0B = (1u << RXEN0) | (1u << TXEN0) | (1u << RXCIE0);
    gonio_init();
    EIMSK = 1u << INT0;
    sei();
    for (;;) {
        gonio_poll();
    }
}
