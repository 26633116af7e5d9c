// The rig's own parts: what the judge of the pins lets pass, and what the chip answers.
import assert from 'node:assert/strict';
import { test } from 'node:test';
import { GPIOPinState, RP2040 } from 'rp2040js';
import { Chip, LIMITS } from './chip.js';
import { Pins } from './pins.js';

const SPI_ON = 2;
const MODE_3 = 0xc0;

// A judge whose pins are moved by hand; time is that of the emulator's clock.
function bench() {
  const rp2040 = new RP2040();
  rp2040.clkPeri = 48e6;
  const pins = new Pins(rp2040, new Chip());
  const { clock } = rp2040;
  const [spi] = rp2040.spi;
  spi.control1 = SPI_ON;
  const at = (us) => clock.tick(Math.max(0, us * 1000 - clock.nanos));
  return {
    pins,
    frame(us, { word = 0x0200, mode = MODE_3, bits = 16, divider = 48, low = 18, words = 1 } = {}) {
      spi.control0 = mode | (bits - 1) | ((divider / 2 - 1) << 8);
      spi.clockDivisor = 2;
      at(us);
      pins.onSelect(GPIOPinState.Low);
      at(us + 0.2);
      for (let k = 0; k < words; k++) pins.onWord(word);
      at(us + low);
      pins.onSelect(GPIOPinState.High);
      return pins.violations.join('; ');
    },
  };
}

test('frames at the limits pass and frames beyond them do not', () => {
  const sound = bench();
  sound.frame(1000);
  assert.equal(sound.frame(1040), '');
  const slow = bench();
  slow.frame(1000, { divider: 192, low: 70 });
  assert.equal(slow.frame(1079), '');
  const cases = [
    [{ us: 1039.9 }, /period of 39900.0 ns/],
    [{ first: { divider: 192, low: 70 }, us: 1078.9 }, /stall of 8900.0 ns/],
    [{ us: 1100, mode: 0x40 }, /not mode 3/],
    [{ us: 1100, mode: 0 }, /not mode 3/],
    [{ us: 1100, bits: 8 }, /8 clocks, not 16/],
    [{ us: 1100, words: 2 }, /16,16 clocks, not 16/],
    [{ us: 1100, words: 0 }, /clocks, not 16/],
    [{ us: 1100, divider: 22 }, /clock of 458.3 ns, at least 500 ns/],
    [{ us: 1100, low: 12 }, /rises within a frame/],
    [{ us: 1100, low: 28 }, /after the last clock/],
  ];
  for (const [{ us, first, ...options }, wanted] of cases) {
    const { frame } = bench();
    frame(1000, first);
    assert.match(frame(us, options), wanted);
  }
});

test('normal mode has limits of its own', () => {
  const run = (us, options) => {
    const { pins, frame } = bench();
    frame(1000, { word: 0xb60a });
    assert.equal(pins.chip.mode, 'normal');
    frame(2000, { divider: 192, low: 70 });
    return frame(us, { divider: 192, low: 70, ...options });
  };
  assert.equal(run(2160), '');
  assert.match(run(2159.9), /period of 159900.0 ns/);
  assert.match(run(2160, { divider: 158 }), /clock of 3291.7 ns/);
  assert.match(run(2500, { low: 150 }), /after the last clock/);
  assert.equal(LIMITS.normal.stallNs, 75e3);
});

test('a word without chip select, an SPI that is off, and RST driven high are violations', () => {
  const { pins } = bench();
  pins.onWord(0);
  pins.onReset(GPIOPinState.High);
  pins.spi.control1 = 0;
  pins.frame = { words: [] };
  pins.onWord(0);
  assert.match(pins.violations.join(), /chip select is high.*driven high.*no master/);
});

// A chip in fast mode that is asked at given milliseconds.
function asked(options) {
  const chip = new Chip(options);
  const frame = (word, ms) => chip.frame(word, ms * 1e6, ms * 1e6 + 18e3);
  return { chip, frame };
}

test('replies come one frame later, by either byte address, and idle is harmless', () => {
  const { frame } = asked();
  assert.equal(frame(0x3600, 1), 0);
  assert.equal(frame(0x3900, 1.1), 0x0001);
  assert.equal(frame(0x0000, 1.2), 0x0402);
  assert.equal(frame(0x0000, 1.3), 0);
});

test('outputs are new once an update', () => {
  const { chip, frame } = asked();
  frame(0x0e00, 5);
  const first = frame(0x0e00, 5.1);
  assert.equal(first & 0xc000, 0x8000);
  assert.ok(Math.abs(((first & 0x3fff) << 18 >> 18) + 2140) < 60);
  assert.equal(frame(0x0e00, 5.2) & 0x8000, 0);
  frame(0x0e00, 5.2 + 1.3);
  assert.equal(frame(0, 6.6) & 0x8000, 0x8000);
  const updates = chip.updates;
  chip.runTo(1e9 + 6.6e6);
  assert.ok(Math.abs(chip.updates - updates - 819.2) < 1.1);
});

test('writes go byte by byte, the rate changes at once, and what cannot be written stays', () => {
  const { chip, frame } = asked();
  frame(0xa134, 1);
  frame(0xa0fe, 1.1);
  frame(0x2000, 1.2);
  assert.equal(frame(0, 1.3), 0x04fe);
  const sample = chip.words[0x0e];
  frame(0x8e00 | (~sample & 0xff), 1.35);
  assert.equal(chip.words[0x0e], sample);
  frame(0xb60a, 2);
  assert.ok(Math.abs(chip.periodNs - 6.714e6) < 1e3);
  frame(0xb680, 3);
  assert.ok(Math.abs(chip.periodNs - 18.92e6) < 1e4);
});

test('a low supply stands in STATUS and in EA, and a read clears until the next update', () => {
  const { frame } = asked({ supplyV: 4.6 });
  frame(0x0e00, 5);
  assert.equal(frame(0x3c00, 5.1) & 0x4000, 0x4000);
  assert.equal(frame(0x3c00, 5.2), 1);
  assert.equal(frame(0x3c00, 5.3), 0);
  frame(0x3c00, 8);
  assert.equal(frame(0, 8.1), 1);
});

test('a reset forgets what is not in flash, and nobody may ask meanwhile', () => {
  const { chip, frame } = asked();
  frame(0xa011, 1);
  frame(0xbe08, 1.1); // flash update
  frame(0xa022, 1.2);
  assert.equal(chip.endurance, 1);
  frame(0xbe80, 2); // software reset
  frame(0x2000, 3);
  assert.match(chip.violations.join(), /starts up/);
  chip.violations.length = 0;
  frame(0x2000, 200);
  assert.equal(frame(0, 200.1), 0x0011);
  frame(0xbe02, 201); // factory restore
  frame(0x2000, 202);
  assert.equal(frame(0, 202.1), 0);
  assert.equal(chip.endurance, 2);
  assert.deepEqual(chip.violations, []);
});
