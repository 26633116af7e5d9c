// What rp2040js lets pass and an RP2040 would not: blocks in reset, clocks that do not run, the flash's
// controller, registers that are not there. Written from the RP2040's data sheet; breaches go to `faults`.
import { BasePeripheral } from 'rp2040js';

const RESET_BIT = {
  0x40014: 5, 0x4001c: 8, 0x40028: 12, 0x4002c: 13, 0x4003c: 16, 0x40054: 21, 0x50110: 24,
};
const NAMES = { 5: 'IO_BANK0', 8: 'PADS_BANK0', 12: 'PLL_SYS', 13: 'PLL_USB', 16: 'SPI0', 21: 'TIMER', 24: 'USBCTRL' };
const ALL = 0x1ffffff;
const AFTER_BOOT_ROM = ALL & ~((1 << 6) | (1 << 9)); // it has woken the flash's pins alone

class Resets extends BasePeripheral {
  value = AFTER_BOOT_ROM;

  readUint32(offset) {
    if (offset === 0) return this.value;
    if (offset === 8) return ~this.value & ALL;
    return super.readUint32(offset);
  }

  writeUint32(offset, value) {
    if (offset === 0) this.value = value & ALL;
    else super.writeUint32(offset, value);
  }
}

// The SSI with a serial flash behind it that knows its 64-bit number (4Bh).
class Flash extends BasePeripheral {
  registers = new Map();
  received = [];
  sent = [];
  selected = false;

  constructor(rp2040, number) {
    super(rp2040, 'SSI');
    this.number = number;
  }

  get(offset) {
    return this.registers.get(offset) ?? 0;
  }

  get on() {
    return this.get(0x08) === 1 && this.get(0x10) === 1;
  }

  // Mapped into memory by 03h: 32-bit words, command of 8 bits, address of 24, a sane even divider.
  get mapped() {
    const divider = this.get(0x14);
    return this.on && this.get(0x00) === ((31 << 16) | (3 << 8)) && this.get(0x04) === 0
      && this.get(0xf4) >>> 0 === 0x03000218 && divider >= 4 && divider % 2 === 0;
  }

  select(low) {
    this.selected = low;
    this.sent = [];
  }

  readUint32(offset) {
    if (offset === 0x28) return 0x2 | 0x4 | (this.received.length ? 0x8 : 0);
    if (offset === 0x60) return this.received.shift() ?? 0;
    if (this.registers.has(offset)) return this.get(offset);
    return super.readUint32(offset);
  }

  writeUint32(offset, value) {
    if (offset === 0x60) {
      this.transfer(value & 0xff);
      return;
    }
    if (![0x00, 0x04, 0x08, 0x10, 0x14, 0xf4].includes(offset)) {
      super.writeUint32(offset, value);
      return;
    }
    if (offset !== 0x08 && this.get(0x08)) this.warn(`register ${offset.toString(16)} written while it is on`);
    this.registers.set(offset, value);
    // What is not mapped cannot be read: whoever tries finds nothing.
    if (offset === 0x08 && !value && this.mappedOnce) this.rp2040.flash.fill(0xff);
  }

  transfer(byte) {
    if (!this.on || this.get(0x00) !== 7 << 16) this.warn('data written, but not set up for bytes both ways');
    if (!this.selected) this.warn('data written while the flash is not selected');
    const at = this.sent.push(byte) - 1;
    this.received.push(this.sent[0] === 0x4b && at >= 5 ? this.number[at - 5] ?? 0xff : 0xff);
  }
}

class FlashPins extends BasePeripheral {
  control = new Uint32Array(6);

  constructor(rp2040, flash) {
    super(rp2040, 'IO_QSPI');
    this.flash = flash;
  }

  readUint32(offset) {
    return offset < 0x30 && offset & 4 ? this.control[offset >> 3] : super.readUint32(offset);
  }

  writeUint32(offset, value) {
    if (offset >= 0x30 || !(offset & 4)) {
      super.writeUint32(offset, value);
      return;
    }
    this.control[offset >> 3] = value;
    if (offset === 0x0c) this.flash.select(((value >> 8) & 3) === 2);
  }
}

export class Silicon {
  faults = [];
  tick = 0;
  usbClock = 0;

  constructor(rp2040, flashNumber) {
    this.rp2040 = rp2040;
    const { peripherals } = rp2040;
    this.resets = peripherals[0x4000c] = new Resets(rp2040, 'RESETS');
    this.flash = peripherals[0x18000] = new Flash(rp2040, flashNumber);
    peripherals[0x40018] = new FlashPins(rp2040, this.flash);
    rp2040.findPeripheral = (address) => {
      const block = (address >>> 14) << 2;
      const bit = RESET_BIT[block];
      if (bit !== undefined && this.resets.value & (1 << bit)) this.fault(`${NAMES[bit]} is used while in reset`);
      return peripherals[block];
    };
    const told = (name, text) => this.fault(`${name}: ${text}`);
    rp2040.logger = { debug() {}, info() {}, warn: told, error: told };
    this.watchTick(peripherals[0x40058], peripherals[0x40054]);
    peripherals[0x40058].onWatchdogTrigger = () => this.fault('the firmware crashed and restarted itself');
  }

  fault(text) {
    if (this.faults.length < 20 && !this.faults.includes(text)) this.faults.push(text);
  }

  requireMapped() {
    if (!this.flash.mapped) this.fault('boot2 leaves the flash unmapped');
    this.flash.mappedOnce = true;
  }

  // The timer counts ticks of the watchdog's divider, which counts clk_ref.
  watchTick(watchdog, timer) {
    const write = watchdog.writeUint32.bind(watchdog);
    watchdog.writeUint32 = (offset, value) => {
      if (offset === 0x2c) this.tick = value & (1 << 9) ? value & 0x1ff : 0;
      write(offset, value);
    };
    const read = timer.readUint32.bind(timer);
    timer.readUint32 = (offset) => {
      if (!this.tick) this.fault('the timer is read before its tick runs');
      return read(offset);
    };
  }

  // Once the firmware is up.
  checkClocks() {
    const { clocks, pllSys, pllUsb, clkSys, clkPeri, xoscFreq } = this.rp2040;
    const expect = (what, is, want) => {
      if (is !== want) this.fault(`${what} is ${is}, not ${want}`);
    };
    expect('clk_sys in Hz', clkSys, 125e6);
    expect('clk_peri in Hz', clkPeri, 48e6);
    expect('clk_ref in Hz', clocks.refFreq, xoscFreq);
    expect('the tick of the timer in Hz', clocks.refFreq / this.tick, 1e6);
    expect('clk_usb enabled, from the USB PLL', clocks.usbCtrl & 0x8e0, 0x800);
    expect('clk_usb in Hz', pllUsb.frequency / (clocks.usbDiv / 256), 48e6);
    for (const [name, pll] of [['PLL_SYS', pllSys], ['PLL_USB', pllUsb]]) {
      const vco = (xoscFreq / pll.refdiv) * pll.fbdiv;
      if (vco < 750e6 || vco > 1600e6) this.fault(`${name}: the oscillator would run at ${vco} Hz`);
      expect(`${name}: bits of PWR that power something down`, pll.pwr & 0b101001, 0);
      if (pll.postdiv1 < pll.postdiv2 || !pll.postdiv2) this.fault(`${name}: dividers the wrong way round`);
    }
    const { gpio } = this.rp2040;
    for (const pin of [16, 18, 19]) expect(`function of pin ${pin}`, gpio[pin].functionSelect, 1);
    for (const pin of [17, 20, 21]) expect(`function of pin ${pin}`, gpio[pin].functionSelect, 5);
    for (const pin of [16, 20]) expect(`input of pin ${pin}`, gpio[pin].inputEnable, true);
    for (const pin of [17, 18, 20, 21]) expect(`pull-up of pin ${pin}`, gpio[pin].pullupEnabled, true);
    for (const pin of [16, 17, 18, 19, 20, 21]) expect(`pull-down of pin ${pin}`, gpio[pin].pulldownEnabled, false);
  }
}
