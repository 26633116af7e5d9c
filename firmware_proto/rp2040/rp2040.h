/* Registers of the RP2040 that the port uses; numbers of sections are those of its data sheet. */
#ifndef RP2040_H
#define RP2040_H

#include <stdint.h>

#define REGISTER(address) (*(volatile uint32_t *)(address))
/* Aliases of most peripherals' registers that set and clear bits in one write (2.1.2). */
#define SET(address) REGISTER((address) + 0x2000u)
#define CLEAR(address) REGISTER((address) + 0x3000u)

/* 2.14 */
#define RESETS 0x4000c000u
#define RESETS_DONE 0x4000c008u
#define RESET_IO_BANK0 (1u << 5)
#define RESET_PADS_BANK0 (1u << 8)
#define RESET_PLL_SYS (1u << 12)
#define RESET_PLL_USB (1u << 13)
#define RESET_SPI0 (1u << 16)
#define RESET_TIMER (1u << 21)
#define RESET_USBCTRL (1u << 24)

/* 2.13 */
#define PSM_WDSEL 0x40010008u
#define PSM_ALL_BUT_OSCILLATORS 0x1fffcu

/* 2.16 */
#define XOSC_CTRL 0x40024000u
#define XOSC_STATUS 0x40024004u
#define XOSC_STARTUP 0x4002400cu
#define XOSC_1_TO_15_MHZ 0xaa0u
#define XOSC_ENABLE (0xfabu << 12)
#define XOSC_STABLE (1u << 31)

/* 2.18 */
#define PLL_SYS 0x40028000u
#define PLL_USB 0x4002c000u
#define PLL_CS 0x0u
#define PLL_PWR 0x4u
#define PLL_FBDIV 0x8u
#define PLL_PRIM 0xcu
#define PLL_LOCK (1u << 31)
#define PLL_PWR_PD (1u << 0)
#define PLL_PWR_POSTDIVPD (1u << 3)
#define PLL_PWR_VCOPD (1u << 5)

/* 2.15 */
#define CLK_REF_CTRL 0x40008030u
#define CLK_REF_SELECTED 0x40008038u
#define CLK_REF_FROM_XOSC 2u
#define CLK_SYS_CTRL 0x4000803cu
#define CLK_SYS_SELECTED 0x40008044u
#define CLK_SYS_FROM_REF 0u
#define CLK_SYS_FROM_AUX 1u /* whose source 0 is PLL_SYS */
#define CLK_PERI_CTRL 0x40008048u
#define CLK_PERI_FROM_PLL_USB (2u << 5)
#define CLK_USB_CTRL 0x40008054u
#define CLK_USB_FROM_PLL_USB (0u << 5)
#define CLK_ENABLE (1u << 11)

/* 4.7: its tick is the timer's too */
#define WATCHDOG_CTRL 0x40058000u
#define WATCHDOG_TRIGGER (1u << 31)
#define WATCHDOG_TICK 0x4005802cu
#define WATCHDOG_TICK_ENABLE (1u << 9)

/* 4.6 */
#define TIMER_ALARM0 0x40054010u
#define TIMER_ARMED 0x40054020u
#define TIMER_RAWL 0x40054028u
#define TIMER_INTR 0x40054034u
#define TIMER_INTE 0x40054038u

/* 2.19 */
#define GPIO_CTRL(pin) (0x40014004u + 8u * (pin))
#define GPIO_SPI 1u
#define GPIO_SIO 5u
#define GPIO_INTR(pin) (0x400140f0u + 4u * ((pin) / 8u))
#define GPIO_INTE(pin) (0x40014100u + 4u * ((pin) / 8u))
#define GPIO_EDGE_LOW(pin) (4u << (4u * ((pin) % 8u)))
#define GPIO_EDGE_HIGH(pin) (8u << (4u * ((pin) % 8u)))
#define PAD(pin) (0x4001c004u + 4u * (pin))
#define PAD_SCHMITT (1u << 1)
#define PAD_PULL_UP (1u << 3)
#define PAD_4_MA (1u << 4)
#define PAD_INPUT (1u << 6)

/* 2.3.1.7 */
#define SIO_OUT_SET 0xd0000014u
#define SIO_OUT_CLEAR 0xd0000018u
#define SIO_OE_SET 0xd0000024u
#define SIO_OE_CLEAR 0xd0000028u

/* 4.4 */
#define SPI0_CR0 0x4003c000u
#define SPI0_CR1 0x4003c004u
#define SPI0_DATA 0x4003c008u
#define SPI0_STATUS 0x4003c00cu
#define SPI0_PRESCALE 0x4003c010u
#define SPI_16_BITS 15u
#define SPI_CLOCK_IDLES_HIGH (1u << 6)
#define SPI_SECOND_EDGE (1u << 7)
#define SPI_ENABLE (1u << 1)
#define SPI_NOT_EMPTY (1u << 2)
#define SPI_BUSY (1u << 4)

/* 4.10: the flash's controller; and its chip select's pin, 2.19.6.2 */
#define SSI_CTRLR0 0x18000000u
#define SSI_ENABLE 0x18000008u
#define SSI_STATUS 0x18000028u
#define SSI_DATA 0x18000060u
#define SSI_BYTES_BOTH_WAYS (7u << 16)
#define SSI_RECEIVED (1u << 3)
#define QSPI_SS_CTRL 0x4001800cu
#define QSPI_SS_LOW (2u << 8)
#define QSPI_SS_OVERRIDE (3u << 8)

/* 2.4.8 */
#define NVIC_ENABLE 0xe000e100u
#define NVIC_DISABLE 0xe000e180u
#define NVIC_PRIORITY(irq) (0xe000e400u + ((irq) & ~3u))
#define IRQ_TIMER_0 0u
#define IRQ_USB 5u
#define IRQ_PINS 13u

#endif
