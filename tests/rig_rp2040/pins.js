// Joins the SPI, chip select, RST and data-ready pins with the chip, and judges every frame. Chip select and
// RST are real edges of the pins. rp2040js makes no edges of clock and data: those follow from the SPI's own
// registers (mode, bits, prescaler, clk_peri) and from the time at which the word was written.
import { GPIOPinState } from 'rp2040js';
import { LIMITS, generator } from './chip.js';

const CS = 17;
const DATA_READY = 20;
const RST = 21;
const T_CS_NS = 48.8;
const LEAD_CLOCKS = 0.5; // from the word's writing to its first edge
const PULSE_NS = 50e3; // of data-ready; the data sheet does not give it
const RESTART_POLL_NS = 1e6;
const CLOCKS_JUDGED_HZ = 100e3;

export class Pins {
  frames = 0;
  fastFrames = 0;
  writes = 0;
  violations = [];
  least = {};
  most = {};
  log = null; // [word, fall, rise, clock, reply] of each frame, where kept
  edges = [];
  resets = [];
  frame = null;
  last = null;

  constructor(rp2040, chip) {
    Object.assign(this, { rp2040, chip, spi: rp2040.spi[0], clock: rp2040.clock });
    this.spi.onTransmit = (word) => this.onWord(word);
    this.done = this.clock.createAlarm(() => this.onDone());
    rp2040.gpio[CS].addListener((value) => this.onSelect(value));
    rp2040.gpio[RST].addListener((value) => this.onReset(value));
    this.ready = this.clock.createAlarm(() => this.onReadyAlarm());
    this.line = rp2040.gpio[DATA_READY];
    this.level = false;
    this.pulse = false;
    this.drive();
    this.ready.schedule(0);
  }

  violate(text) {
    if (this.violations.length < 20) {
      this.violations.push(`frame ${this.frames} at ${(this.clock.nanos * 1e-9).toFixed(6)} s: ${text}`);
    } else this.more = (this.more ?? 0) + 1;
  }

  // -- SPI -------------------------------------------------------------------------------------------

  onWord(word) {
    const now = this.clock.nanos;
    const { spi } = this;
    const hz = spi.clockFrequency;
    const sound = spi.control1 === 2 && hz > 0; // enabled, master, no loop
    if (!sound) this.violate('a word is sent while the SPI is off or no master');
    if (!this.frame) this.violate('a word is sent while chip select is high');
    else {
      const mode = (spi.control0 >> 6) & 3;
      if (mode !== 3 || (spi.control0 >> 4) & 3) this.violate(`not mode 3: SSPCR0 is 0x${spi.control0.toString(16)}`);
      this.frame.words.push({ word, bits: spi.dataBits, start: now + (LEAD_CLOCKS / hz) * 1e9, hz });
    }
    this.busy = true;
    this.done.schedule(((LEAD_CLOCKS + spi.dataBits) / (hz || 1e6)) * 1e9);
  }

  onDone() {
    this.busy = false;
    this.spi.completeTransmit(this.frame ? this.frame.reply : 0xffff);
  }

  onSelect(value) {
    const now = this.clock.nanos;
    if (value === GPIOPinState.Low) {
      this.chip.runTo(now);
      this.frame = { fall: now, words: [], mode: this.chip.mode, reply: this.chip.pending };
    } else if (this.frame && value === GPIOPinState.High) this.end(this.frame, now);
  }

  end(frame, rise) {
    this.frame = null;
    this.vcd?.frame(frame, rise);
    const limits = LIMITS[frame.mode];
    const [sent] = frame.words;
    if (frame.words.length !== 1 || sent.bits !== 16) {
      this.violate(`${frame.words.map((part) => part.bits)} clocks, not 16`);
    } else {
      const last = sent.start + (15.5 / sent.hz) * 1e9;
      const over = sent.start + (16 / sent.hz) * 1e9;
      this.atLeast(frame, 'lead', sent.start - frame.fall, T_CS_NS);
      this.atLeast(frame, 'trail', rise - last, T_CS_NS);
      this.atLeast(frame, 'clock', 1e9 / sent.hz, 1e9 / limits.mostHz);
      this.most.clock = Math.max(this.most.clock ?? 0, 1e9 / sent.hz);
      if (sent.hz < limits.leastHz) this.violate(`a clock of ${sent.hz} Hz`);
      if (sent.hz >= CLOCKS_JUDGED_HZ) {
        this.most.hold = Math.max(this.most.hold ?? 0, rise - over);
        if (rise - over > limits.holdNs) this.violate(`chip select rises ${rise - over} ns after the last clock`);
      }
      if (this.busy) this.violate('chip select rises within a frame');
      this.finish(frame, sent, rise);
    }
    if (this.last) {
      this.atLeast(frame, 'stall', frame.fall - this.last.rise, limits.stallNs);
      this.atLeast(frame, 'period', frame.fall - this.last.fall, limits.periodNs);
    }
    this.last = { fall: frame.fall, rise };
    this.frames++;
    this.fastFrames += frame.mode === 'fast';
  }

  finish(frame, { word, hz }, rise) {
    const before = this.chip.violations.length;
    const reply = this.chip.frame(word, frame.fall, rise);
    if (reply !== frame.reply) this.violate(`shifted out 0x${frame.reply.toString(16)}, not 0x${reply.toString(16)}`);
    for (const text of this.chip.violations.slice(before)) this.violate(text);
    this.log?.push([word, frame.fall, rise, hz, reply]);
    if (word & 0x8000) {
      this.writes++;
      this.drive();
      this.schedule();
    }
  }

  atLeast(frame, what, value, limit) {
    const key = `${frame.mode} ${what}`;
    this.least[key] = Math.min(value, this.least[key] ?? Infinity);
    if (value < limit - 1e-3) this.violate(`${what} of ${value.toFixed(1)} ns, at least ${limit} ns`);
  }

  // -- RST -------------------------------------------------------------------------------------------

  onReset(value) {
    const now = this.clock.nanos;
    if (value === GPIOPinState.High) this.violate('RST is driven high');
    if (value === GPIOPinState.Low) this.resetFrom = now;
    else if (this.resetFrom !== undefined) {
      this.resets.push([this.resetFrom, now]);
      this.resetFrom = undefined;
      this.chip.restart(now);
      this.drive();
      this.schedule();
    }
  }

  // -- data-ready --------------------------------------------------------------------------------------

  schedule() {
    if (this.noisy) return;
    this.pulse = false;
    this.drive();
    this.ready.schedule(Math.max(0, this.chip.nextUpdateNs - this.clock.nanos));
  }

  onReadyAlarm() {
    const now = this.clock.nanos;
    if (this.pulse) {
      this.pulse = false;
      this.drive();
      this.ready.schedule(Math.max(0, this.chip.nextUpdateNs - now));
      return;
    }
    this.chip.runTo(now);
    if (now < this.chip.readyNs) {
      this.ready.schedule(RESTART_POLL_NS);
      return;
    }
    if (this.chip.dataReady.on && this.chip.dataReady.line === 0) this.edges.push(now);
    this.pulse = true;
    this.drive();
    this.ready.schedule(PULSE_NS);
  }

  // Edges of data-ready at random times from now on, whatever the chip does.
  noise(meanNs) {
    this.ready.cancel();
    this.noisy = true;
    const random = generator(7);
    const alarm = this.clock.createAlarm(() => {
      this.set(!this.level);
      alarm.schedule(1000 - (meanNs / 2) * Math.log(1 - random()));
    });
    alarm.schedule(0);
  }

  // DIO1, which idles opposite to its pulse; while it is no data-ready the board's pull-up holds it.
  drive() {
    if (this.noisy) return;
    const { on, high, line } = this.chip.dataReady;
    this.set(on && line === 0 ? this.pulse === high : true);
  }

  set(level) {
    if (level !== this.level) {
      this.level = level;
      this.line.setInputValue(level);
    }
  }
}
