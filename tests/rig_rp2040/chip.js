// An ADIS16354 at frame level, written from the description of its registers alone: pipelined replies, ND and
// EA, both modes' limits, sample clock, data-ready, flash, resets. It lies still; its filter is not modelled.
const TICK_NS = 1e9 / 1638.4; // 0.61035 ms
const SLOW_TICKS = 31; // 18.921 ms
const LAST_FAST = 0x09;
const START_UP_NS = 150e6;
const OUTPUTS = [0x02, 0x04, 0x06, 0x08, 0x0a, 0x0c, 0x0e, 0x10, 0x12, 0x14, 0x16];
const WIDTH_12 = new Set([0x02, 0x10, 0x12, 0x14, 0x16]);
const ENDURANCE = 0x00;
const MSC_CTRL = 0x34;
const SMPL_PRD = 0x36;
const STATUS = 0x3c;
const COMMAND = 0x3e;
// Bits that can be written, by word.
const WRITABLE = {
  0x1a: 0x1fff, 0x1c: 0x1fff, 0x1e: 0x1fff, 0x20: 0x0fff, 0x22: 0x0fff, 0x24: 0x0fff, 0x26: 0xbfff,
  0x28: 0xbfff, 0x2a: 0x00ff, 0x2c: 0x00ff, 0x2e: 0xffd7, 0x30: 0x0fff, 0x32: 0x0303, 0x34: 0x07c7,
  0x36: 0x00ff, 0x38: 0x0707, 0x3a: 0x00ff, 0x3e: 0x00ff,
};
// Bits that have a copy in flash, by word; those of the other words are volatile.
const SAVED = { ...WRITABLE, 0x30: 0, 0x32: 0, 0x34: 0x00ff, 0x3a: 0, 0x3e: 0 };
const DEFAULTS = { 0x36: 0x0001, 0x38: 0x0402 };
const ACCEL_LSB_MG = { adis16354: 0.4672, adis16350: 2.522 };
const NOISE_MG = 4.7;

export const LIMITS = {
  fast: { stallNs: 9e3, periodNs: 40e3, leastHz: 10e3, mostHz: 2e6, holdNs: 10e3 },
  normal: { stallNs: 75e3, periodNs: 160e3, leastHz: 10e3, mostHz: 300e3, holdNs: 80e3 },
};

export class Chip {
  endurance = 0;
  updates = 0;
  violations = [];

  constructor({ part = 'adis16354', seed = 1, accelMg = [0, 0, -1000], supplyV = 5, poweredNs = -500e6 } = {}) {
    Object.assign(this, { part, accelMg, supplyV });
    this.random = generator(seed);
    this.saved = { ...DEFAULTS };
    this.restart(poweredNs);
  }

  // -- state ---------------------------------------------------------------------------------------

  restart(ns) {
    this.words = new Uint16Array(0x40);
    for (const [address, value] of Object.entries(this.saved)) this.words[address] = value;
    this.fresh = new Set();
    this.status = 0;
    this.pending = 0; // word that the next frame shifts out
    this.readyNs = ns + START_UP_NS;
    this.nextUpdateNs = this.readyNs + this.periodNs;
  }

  get mode() {
    return (this.words[SMPL_PRD] & 0xff) <= LAST_FAST ? 'fast' : 'normal';
  }

  get periodNs() {
    const value = this.words[SMPL_PRD];
    return TICK_NS * (value & 0x80 ? SLOW_TICKS : 1) * ((value & 0x7f) + 1);
  }

  get dataReady() {
    const value = this.words[MSC_CTRL];
    return { on: Boolean(value & 4), high: Boolean(value & 2), line: value & 1 };
  }

  runTo(ns) {
    while (this.nextUpdateNs <= ns) {
      this.update();
      this.nextUpdateNs += this.periodNs;
    }
  }

  update() {
    this.updates++;
    const gaussian = () => this.random() + this.random() + this.random() + this.random() - 2; // rms 0.577
    const lsb = ACCEL_LSB_MG[this.part];
    const accel = this.accelMg.map((mg, k) =>
      Math.round((mg + (NOISE_MG * gaussian()) / 0.577) / lsb) + signed(this.words[0x20 + 2 * k], 12));
    const gyro = [0, 1, 2].map((k) =>
      Math.round((0.6 * gaussian()) / 0.577 / 0.07326) + (signed(this.words[0x1a + 2 * k], 13) >> 2));
    const supply = Math.round(this.supplyV / 1.8315e-3 + gaussian());
    const raw = [supply, ...gyro, ...accel, 14, 15, 16, 0].map((value, k) => [OUTPUTS[k], value]);
    for (const [address, value] of raw) {
      this.words[address] = value & (WIDTH_12.has(address) ? 0x0fff : 0x3fff);
      this.fresh.add(address);
    }
    const supplyBits = this.supplyV > 5.25 ? 2 : this.supplyV < 4.75 ? 1 : 0;
    this.status = (this.status & ~3) | supplyBits;
  }

  // -- frames ----------------------------------------------------------------------------------------

  // A frame is over; returns what was shifted out during it.
  frame(word, fallNs, riseNs) {
    const reply = this.pending;
    this.pending = 0;
    if (fallNs < this.readyNs) {
      this.violations.push(`0x${word.toString(16)} while the chip starts up`);
      return reply;
    }
    this.runTo(riseNs);
    const address = (word >> 8) & 0x3f;
    if (word & 0x4000) this.violations.push(`bit 14 is set in 0x${word.toString(16)}`);
    if (word & 0x8000) this.write(address, word & 0xff, riseNs);
    else this.pending = this.read(address & 0x3e);
    return reply;
  }

  read(address) {
    if (address === ENDURANCE) return this.endurance & 0x7fff;
    if (address === COMMAND || address === 0x18) return 0;
    if (address === STATUS) {
      const value = this.status;
      this.status = 0;
      return value;
    }
    if (!OUTPUTS.includes(address)) return this.words[address];
    const nd = this.fresh.delete(address) ? 0x8000 : 0;
    return this.words[address] | nd | (this.status ? 0x4000 : 0);
  }

  write(address, data, ns) {
    const word = address & 0x3e;
    const high = address & 1;
    const mask = (WRITABLE[word] ?? 0) & (high ? 0xff00 : 0x00ff);
    const before = this.periodNs;
    this.words[word] = (this.words[word] & ~mask) | ((high ? data << 8 : data) & mask);
    if (this.periodNs !== before) this.nextUpdateNs = ns + this.periodNs;
    if (word === COMMAND && !high) this.command(data, ns);
  }

  command(bits, ns) {
    this.words[COMMAND] = 0;
    if (bits & 0x80) this.restart(ns);
    if (bits & 0x02) for (let word = 0x1a; word <= 0x24; word += 2) this.words[word] = 0;
    if (bits & 0x0a) {
      this.endurance++;
      for (const [word, mask] of Object.entries(SAVED)) if (mask) this.saved[word] = this.words[word] & mask;
    }
    if (bits & 0x15) this.violations.push(`COMMAND 0x${bits.toString(16)} is not modelled`);
  }
}

function signed(value, bits) {
  return (value << (32 - bits)) >> (32 - bits);
}

// Numbers in [0, 1), the same for the same seed.
export function generator(seed) {
  let state = seed >>> 0 || 1;
  return () => {
    state ^= state << 13;
    state ^= state >>> 17;
    state ^= state << 5;
    state >>>= 0;
    return state / 0x100000000;
  };
}
