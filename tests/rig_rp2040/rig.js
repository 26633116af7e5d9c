// The rig: one JSON request a line on stdin, one answer a line on stdout, until stdin ends. Time runs only
// within a request, so whoever asks decides how fast it goes, and every run is the same.
import { readSync, writeSync } from 'node:fs';
import { RP2040 } from 'rp2040js';
import { Chip } from './chip.js';
import { boot, readUf2 } from './image.js';
import { Pins } from './pins.js';
import { Silicon } from './silicon.js';
import { StockHost, UsbHost } from './usb_host.js';
import { Vcd } from './vcd.js';

const FLASH_NUMBER = [0xe6, 0x61, 0x41, 0x03, 0xe7, 0x35, 0x29, 0x2b];
const PAINT = 0xc5;
const RAM = 0x20000000;
const RAM_END = 0x20040000;

class Rig {
  constructor({ image, chip = {}, stock_host = false }) {
    this.rp2040 = new RP2040();
    this.clock = this.rp2040.clock;
    this.silicon = new Silicon(this.rp2040, FLASH_NUMBER);
    this.chip = new Chip(chip);
    this.twin = new Chip(chip);
    this.pins = new Pins(this.rp2040, this.chip);
    this.host = stock_host ? new StockHost(this.rp2040) : new UsbHost(this.rp2040, this.silicon);
    boot(this.rp2040, this.silicon, readUf2(image));
    this.powered = true;
  }

  // Until a time, or until bytes for the host's program have arrived.
  run(endNs, forData) {
    const { rp2040, clock, host } = this;
    const { core } = rp2040;
    while (clock.nanos < endNs && !(forData && host.arrived.length)) {
      const cycle = 1e9 / rp2040.clkSys;
      if (!this.powered) clock.tick(endNs - clock.nanos);
      else if (core.waiting) clock.tick(Math.max(0, Math.min(clock.nanosToNextAlarm, endNs - clock.nanos)));
      else for (let k = 0; k < 32 && !core.waiting; k++) clock.tick(core.executeInstruction() * cycle);
    }
  }

  answer(request) {
    const { pins, host, chip } = this;
    switch (request.op) {
      case 'run':
        host.sending.push(...Buffer.from(request.send ?? '', 'hex'));
        this.run(request.until_ns, request.for_data);
        return { ns: this.clock.nanos, data: this.take() };
      case 'unplug':
        this.powered = host.plugged = false;
        return {};
      case 'host': // whoever reads slowly, sets a baud rate, or resets the endpoints
        if (request.in_every) host.inEvery = request.in_every;
        if (request.baud) host.start(host.setLine(request.baud));
        if (request.clear_halt) host.start(host.clearHalt());
        return {};
      case 'state':
        if (host.ends) this.silicon.checkClocks();
        return {
          frames: pins.frames, fast_frames: pins.fastFrames, writes: pins.writes, least_ns: pins.least,
          most_ns: pins.most, violations: pins.violations, more: pins.more ?? 0, resets_ns: pins.resets,
          faults: this.silicon.faults, usb: host.info, memory: [...chip.words],
          endurance: chip.endurance, cycles: this.rp2040.core.cycles, transactions: host.transactions,
        };
      case 'edges':
        return { ns: pins.edges };
      case 'keep':
        pins.log = [];
        return {};
      case 'vcd': // a capture of the SPI pins from now on
        pins.vcd = new Vcd(request.path);
        return {};
      case 'frames':
        return { frames: pins.log.slice(request.from) };
      case 'forget':
        pins.least = {};
        pins.most = {};
        return {};
      case 'noise':
        pins.noise(request.mean_ns);
        return {};
      case 'twin': // the same chip again, given a frame by hand
        return { reply: this.twin.frame(request.word, request.fall_ns, request.rise_ns) };
      case 'paint':
        this.rp2040.sram.fill(PAINT, request.from - RAM, this.rp2040.core.SP - RAM - 8);
        return {};
      case 'stack': {
        let at = request.from;
        while (this.rp2040.sram[at - RAM] === PAINT) at++;
        return { bytes: RAM_END - at };
      }
      default:
        throw new Error(`no request ${request.op}`);
    }
  }

  take() {
    const data = Buffer.from(this.host.arrived).toString('hex');
    this.host.arrived = [];
    return data;
  }
}

function* lines() {
  const chunk = Buffer.alloc(65536);
  let text = '';
  for (let count; (count = readSync(0, chunk)) > 0; ) {
    text += chunk.toString('latin1', 0, count);
    for (let end; (end = text.indexOf('\n')) >= 0; text = text.slice(end + 1)) yield JSON.parse(text.slice(0, end));
  }
}

let rig = null;
for (const request of lines()) {
  let answer;
  try {
    if (request.op === 'new') {
      rig = null;
      rig = new Rig(request);
      answer = {};
    } else answer = rig.answer(request);
  } catch (error) {
    answer = { error: error.stack };
  }
  let out = Buffer.from(`${JSON.stringify(answer)}\n`);
  while (out.length) out = out.subarray(writeSync(1, out));
}
