/* Second stage of the boot. The boot ROM checks the first 256 bytes of the flash by the CRC-32 in their last
 * word (uf2.py writes it), copies them to the top of the RAM and calls them. They map the flash into memory
 * by the plainest read that every serial flash knows (03h: one line, no mode bits) at a quarter of clk_sys,
 * and go on at the vector table behind them. RP2040 data sheet, 2.8.1.3 (boot) and 4.10 (SSI).
 */
    .syntax unified
    .cpu cortex-m0plus
    .thumb

#define SSI 0x18000000
#define CTRLR0 0x00
#define CTRLR1 0x04
#define SSIENR 0x08
#define SER 0x10
#define BAUDR 0x14
#define SPI_CTRLR0 0xf4

/* 31.25 MHz at 125 MHz; the slowest of the usual parts takes 33 MHz for 03h. */
#define DIVIDER 4
/* Frames of 32 bits, command and address out, one word in ("EEPROM read"). */
#define CONTROL ((31 << 16) | (3 << 8))
/* Command 03h of 8 bits, address of 24, all on one line. */
#define SPI_CONTROL ((0x03 << 24) | (2 << 8) | (6 << 2))

#define FLASH_VECTORS 0x10000100
#define VTOR 0xe000ed08

    .section .boot2, "ax"
    .global boot2
    .thumb_func
boot2:
    ldr r3, =SSI
    movs r1, #0
    str r1, [r3, #SSIENR] /* the rest is written while it is off */
    str r1, [r3, #CTRLR1] /* one word a read */
    movs r1, #DIVIDER
    str r1, [r3, #BAUDR]
    ldr r1, =CONTROL
    str r1, [r3, #CTRLR0]
    ldr r1, =SPI_CONTROL
    ldr r0, =(SSI + SPI_CTRLR0)
    str r1, [r0]
    movs r1, #1
    str r1, [r3, #SER]
    str r1, [r3, #SSIENR]

    ldr r0, =FLASH_VECTORS
    ldr r1, =VTOR
    str r0, [r1]
    ldmia r0!, {r1, r2}
    msr msp, r1
    bx r2

    .ltorg
