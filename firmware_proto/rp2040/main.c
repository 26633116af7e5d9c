/* Raspberry Pi Pico: RP2040 with a crystal of 12 MHz. Pins and wiring: docs/hardware.md.
 *
 * The timer counts microseconds for ever. The times of chip select are taken from it after each edge was
 * made, so whatever interrupts make a frame longer or later, never shorter or earlier.
 */
#include <string.h>

#include "gonio_board.h"
#include "gonio_core.h"
#include "rp2040.h"
#include "usb.h"

/* SPI0 on the pins that the Pico's own drawings give it; the six lie side by side. */
#define MISO 16u
#define CS 17u
#define SCK 18u
#define MOSI 19u
#define DATA_READY 20u
#define RST 21u
#define BIT(pin) (1u << (pin))

#define SYSTEM_HZ 125000000u
#define CRYSTAL_MHZ 12u
#define SPI_SOURCE_HZ 48000000u

/* SLP_CNT wants CS high within 10 us after the 16th clock: so long before it USB's interrupt, which takes up to ten,
 * does not begin. Data-ready's takes a microsecond or two and is never held off here. */
#define QUIET_US 16u
/* Less than this is not worth sleeping. */
#define LEAST_SLEEP_US 5u
#define LONGEST_SLEEP_US 1000000u

#define BOARD "rp2040 "
#define FLASH_ID_SIZE 8u

const uint16_t board_capabilities = GP_CAP_DATA_READY | GP_CAP_HARD_RESET | GP_CAP_USB;

/* 2 MHz, the chip's limit, is left out: a crystal may be fast by some millionths. */
const uint32_t board_clocks_hz[GP_CLOCKS] = {1000000u, 500000u, 250000u, 125000u, 50000u, 20000u};
/* 48 MHz divided by prescale and by step + 1 gives them exactly. */
static const struct {
    uint8_t prescale, step;
} dividers[GP_CLOCKS] = {{2, 23}, {2, 47}, {2, 95}, {2, 191}, {4, 239}, {10, 239}};

static uint32_t started_us, risen_us, stall_us, period_us, loud_us;
static uint32_t edge;
static char serial_number[2u * FLASH_ID_SIZE + 1u];

void on_alarm(void);
void on_pins(void);
void on_usb(void);
void fault(void);

/* -- time -------------------------------------------------------------------------------------------- */

uint32_t board_now_us(void)
{
    return REGISTER(TIMER_RAWL);
}

void board_lock(void)
{
    __asm volatile("cpsid i" ::: "memory");
}

void board_unlock(void)
{
    __asm volatile("cpsie i" ::: "memory");
}

/* Only wakes the processor. */
void on_alarm(void)
{
    REGISTER(TIMER_INTR) = 1u;
}

/* Until an interrupt; one since the last sleep counts, so none is missed between gonio_poll() and here. */
static void sleep(uint32_t time_us)
{
    if (time_us < LEAST_SLEEP_US) {
        return;
    }
    if (time_us > LONGEST_SLEEP_US) {
        time_us = LONGEST_SLEEP_US;
    }
    REGISTER(TIMER_ALARM0) = board_now_us() + time_us - LEAST_SLEEP_US + 2u;
    __asm volatile("wfe" ::: "memory");
    REGISTER(TIMER_ARMED) = 1u;
}

/* -- frames ------------------------------------------------------------------------------------------ */

void board_set_timing(uint8_t clock, uint16_t stall, uint16_t period)
{
    uint32_t frame_us = 16000000u / board_clocks_hz[clock];
    REGISTER(SPI0_CR1) = 0;
    REGISTER(SPI0_PRESCALE) = dividers[clock].prescale;
    REGISTER(SPI0_CR0) =
        ((uint32_t)dividers[clock].step << 8) | SPI_SECOND_EDGE | SPI_CLOCK_IDLES_HIGH | SPI_16_BITS;
    REGISTER(SPI0_CR1) = SPI_ENABLE;
    loud_us = frame_us - QUIET_US;
    stall_us = stall;
    period_us = period;
}

uint16_t board_frame(uint16_t word)
{
    /* a difference of n + 1 counts is n microseconds at least */
    while (board_now_us() - risen_us <= stall_us || board_now_us() - started_us <= period_us) {
    }
    REGISTER(SIO_OUT_CLEAR) = BIT(CS);
    REGISTER(SPI0_DATA) = word;
    started_us = board_now_us();
    while (board_now_us() - started_us < loud_us) {
    }
    usb_hold();
    while ((REGISTER(SPI0_STATUS) & SPI_NOT_EMPTY) == 0u || (REGISTER(SPI0_STATUS) & SPI_BUSY) != 0u) {
    }
    REGISTER(SIO_OUT_SET) = BIT(CS);
    risen_us = board_now_us();
    usb_release();
    return (uint16_t)REGISTER(SPI0_DATA);
}

void board_reset_chip(uint16_t low_us)
{
    uint32_t from = board_now_us();
    REGISTER(SIO_OE_SET) = BIT(RST); /* open drain: the port's bit stays 0 */
    while (board_now_us() - from <= low_us) {
    }
    REGISTER(SIO_OE_CLEAR) = BIT(RST);
}

/* -- data-ready ---------------------------------------------------------------------------------------- */

void board_select_edge(uint8_t falling)
{
    uint32_t chosen = falling != 0u ? GPIO_EDGE_LOW(DATA_READY) : GPIO_EDGE_HIGH(DATA_READY);
    board_lock();
    edge = chosen;
    REGISTER(GPIO_INTE(DATA_READY)) = chosen;
    REGISTER(GPIO_INTR(DATA_READY)) = chosen; /* what lies behind is no edge */
    board_unlock();
}

void on_pins(void)
{
    uint32_t now_us = board_now_us();
    REGISTER(GPIO_INTR(DATA_READY)) = edge;
    gonio_on_edge(now_us);
}

/* -- serial port --------------------------------------------------------------------------------------- */

void on_usb(void)
{
    usb_interrupt();
}

uint8_t board_receive(uint8_t *byte)
{
    return usb_receive(byte);
}

/* The host is held off while there is no room. */
uint16_t board_receive_overruns(void)
{
    return 0;
}

uint16_t board_send_room(void)
{
    return usb_room();
}

void board_send(uint8_t byte)
{
    usb_put(byte);
}

void board_send_now(void)
{
    usb_flush();
}

/* -- name ---------------------------------------------------------------------------------------------- */

uint8_t board_name(uint8_t *text, uint8_t room)
{
    uint8_t length = sizeof BOARD - 1u;
    (void)room; /* 23 */
    memcpy(text, BOARD, length);
    memcpy(text + length, serial_number, sizeof serial_number - 1u);
    return (uint8_t)(length + sizeof serial_number - 1u);
}

static uint8_t flash_byte(uint8_t out)
{
    REGISTER(SSI_DATA) = out;
    while ((REGISTER(SSI_STATUS) & SSI_RECEIVED) == 0u) {
    }
    return (uint8_t)REGISTER(SSI_DATA);
}

/* The RP2040 has no number of its own, the Pico's flash has (command 4Bh). The flash is not read any more:
 * everything runs from RAM. */
static void read_flash_id(void)
{
    static const char digits[] = "0123456789ABCDEF";
    uint32_t k;
    REGISTER(SSI_ENABLE) = 0;
    REGISTER(SSI_CTRLR0) = SSI_BYTES_BOTH_WAYS;
    REGISTER(SSI_ENABLE) = 1;
    CLEAR(QSPI_SS_CTRL) = QSPI_SS_OVERRIDE;
    SET(QSPI_SS_CTRL) = QSPI_SS_LOW;
    (void)flash_byte(0x4b);
    for (k = 0; k < 4u; k++) {
        (void)flash_byte(0);
    }
    for (k = 0; k < FLASH_ID_SIZE; k++) {
        uint8_t byte = flash_byte(0);
        serial_number[2u * k] = digits[byte >> 4];
        serial_number[2u * k + 1u] = digits[byte & 15u];
    }
    CLEAR(QSPI_SS_CTRL) = QSPI_SS_OVERRIDE;
}

/* -- start --------------------------------------------------------------------------------------------- */

static void wake(uint32_t blocks)
{
    SET(RESETS) = blocks;
    CLEAR(RESETS) = blocks;
    while ((REGISTER(RESETS_DONE) & blocks) != blocks) {
    }
}

/* Crystal · multiplier / (first · second); crystal · multiplier lies between 750 and 1600 MHz. */
static void start_pll(uint32_t pll, uint32_t multiplier, uint32_t first, uint32_t second)
{
    REGISTER(pll + PLL_CS) = 1u;
    REGISTER(pll + PLL_FBDIV) = multiplier;
    CLEAR(pll + PLL_PWR) = PLL_PWR_PD | PLL_PWR_VCOPD;
    while ((REGISTER(pll + PLL_CS) & PLL_LOCK) == 0u) {
    }
    REGISTER(pll + PLL_PRIM) = (first << 16) | (second << 12);
    CLEAR(pll + PLL_PWR) = PLL_PWR_POSTDIVPD;
}

static void switch_clock(uint32_t control, uint32_t selected, uint32_t source)
{
    REGISTER(control) = source;
    while (REGISTER(selected) != 1u << source) {
    }
}

static void start_clocks(void)
{
    REGISTER(XOSC_STARTUP) = 47u; /* times 256 cycles: 1 ms */
    REGISTER(XOSC_CTRL) = XOSC_ENABLE | XOSC_1_TO_15_MHZ;
    while ((REGISTER(XOSC_STATUS) & XOSC_STABLE) == 0u) {
    }
    CLEAR(CLK_SYS_CTRL) = CLK_SYS_FROM_AUX; /* first off the other source, which may not change in use */
    while (REGISTER(CLK_SYS_SELECTED) != 1u << CLK_SYS_FROM_REF) {
    }
    switch_clock(CLK_REF_CTRL, CLK_REF_SELECTED, CLK_REF_FROM_XOSC);
    wake(RESET_PLL_SYS | RESET_PLL_USB);
    start_pll(PLL_SYS, 125u, 6u, 2u);
    start_pll(PLL_USB, 100u, 5u, 5u);
    switch_clock(CLK_SYS_CTRL, CLK_SYS_SELECTED, CLK_SYS_FROM_AUX);
    REGISTER(CLK_PERI_CTRL) = CLK_ENABLE | CLK_PERI_FROM_PLL_USB;
    REGISTER(CLK_USB_CTRL) = CLK_ENABLE | CLK_USB_FROM_PLL_USB;
    REGISTER(WATCHDOG_TICK) = WATCHDOG_TICK_ENABLE | CRYSTAL_MHZ;
}

static void start_pins(void)
{
    REGISTER(SIO_OUT_SET) = BIT(CS);
    REGISTER(SIO_OUT_CLEAR) = BIT(RST);
    REGISTER(PAD(MISO)) = PAD_INPUT | PAD_SCHMITT;
    REGISTER(PAD(CS)) = PAD_INPUT | PAD_SCHMITT | PAD_PULL_UP | PAD_4_MA;
    REGISTER(PAD(SCK)) = PAD_INPUT | PAD_SCHMITT | PAD_PULL_UP | PAD_4_MA;
    REGISTER(PAD(MOSI)) = PAD_INPUT | PAD_SCHMITT | PAD_4_MA;
    REGISTER(PAD(DATA_READY)) = PAD_INPUT | PAD_SCHMITT | PAD_PULL_UP; /* unwired it makes no edges */
    REGISTER(PAD(RST)) = PAD_INPUT | PAD_SCHMITT | PAD_PULL_UP | PAD_4_MA;
    REGISTER(SIO_OE_SET) = BIT(CS);
    REGISTER(SIO_OE_CLEAR) = BIT(RST) | BIT(DATA_READY);
    REGISTER(GPIO_CTRL(CS)) = GPIO_SIO;
    REGISTER(GPIO_CTRL(RST)) = GPIO_SIO;
    REGISTER(GPIO_CTRL(DATA_READY)) = GPIO_SIO;
    board_set_timing(2, GP_DEFAULT_STALL_US, GP_DEFAULT_PERIOD_US); /* the clock idles high before it shows */
    REGISTER(GPIO_CTRL(MISO)) = GPIO_SPI;
    REGISTER(GPIO_CTRL(SCK)) = GPIO_SPI;
    REGISTER(GPIO_CTRL(MOSI)) = GPIO_SPI;
}

/* Restart everything but the oscillators: the host's next request learns of it by `no_session`. */
void fault(void)
{
    REGISTER(PSM_WDSEL) = PSM_ALL_BUT_OSCILLATORS;
    REGISTER(WATCHDOG_CTRL) = WATCHDOG_TRIGGER;
    for (;;) {
    }
}

int main(void)
{
    start_clocks();
    wake(RESET_IO_BANK0 | RESET_PADS_BANK0 | RESET_SPI0 | RESET_TIMER | RESET_USBCTRL);
    start_pins();
    read_flash_id();
    REGISTER(NVIC_PRIORITY(IRQ_TIMER_0)) = 0x80u; /* data-ready first, then USB */
    REGISTER(NVIC_PRIORITY(IRQ_USB)) = 0x8000u;
    REGISTER(NVIC_PRIORITY(IRQ_PINS)) = 0;
    gonio_init();
    REGISTER(TIMER_INTE) = 1u;
    REGISTER(NVIC_ENABLE) = (1u << IRQ_TIMER_0) | (1u << IRQ_PINS);
    usb_start(serial_number);
    for (;;) {
        sleep(gonio_poll());
    }
}
