/* From the reset to main(): everything runs from RAM, so that no frame ever waits for the flash. */
    .syntax unified
    .cpu cortex-m0plus
    .thumb

    .section .flash_start, "ax"
    .align 2
    .word __stack_top /* the vector table that boot2 enters; there is no NMI, and a fault ends here */
    .word reset
    .word halt
    .word halt

    .global reset
    .thumb_func
reset:
    ldr r0, =__ram_image
    ldr r1, =__ram_start
    ldr r2, =__ram_end
    b 2f
1:  ldmia r0!, {r3}
    stmia r1!, {r3}
2:  cmp r1, r2
    blo 1b
    ldr r2, =__bss_end
    movs r3, #0
    b 4f
3:  stmia r1!, {r3}
4:  cmp r1, r2
    blo 3b
    ldr r0, =vectors
    ldr r1, =0xe000ed08 /* VTOR */
    str r0, [r1]
    ldr r0, =main
    blx r0
    .thumb_func
halt:
    b halt
    .ltorg

    .section .vectors, "a"
    .align 8
vectors:
    .word __stack_top
    .word reset
    .word fault /* NMI */
    .word fault
    .fill 7, 4, 0
    .word fault /* SVC */
    .fill 2, 4, 0
    .word fault /* PendSV */
    .word fault /* SysTick */
    .word on_alarm /* 0: TIMER_IRQ_0 */
    .rept 4
    .word fault
    .endr
    .word on_usb /* 5: USBCTRL */
    .rept 7
    .word fault
    .endr
    .word on_pins /* 13: IO_BANK0 */
    .rept 12
    .word fault
    .endr
