// The UF2 file into the flash, and what the boot ROM does with it: RP2040 data sheet, 2.8.1.
import { readFileSync } from 'node:fs';

const FLASH = 0x10000000;
const FAMILY = 0xe48bff56;
const BLOCK = 512;
const BOOT2 = 0x20041f00;
const FROM_FLASH = 0x10000100;
const BOOT2_STEPS = 200;

export function readUf2(path) {
  const file = readFileSync(path);
  const view = new DataView(file.buffer, file.byteOffset, file.length);
  if (!file.length || file.length % BLOCK) throw new Error(`${path}: not whole blocks of ${BLOCK} bytes`);
  const count = file.length / BLOCK;
  const parts = [];
  for (let k = 0; k < count; k++) {
    const word = (at) => view.getUint32(k * BLOCK + at, true);
    const head = [word(0), word(4), word(8), word(12), word(16), word(20), word(24), word(28)];
    const want = [0x0a324655, 0x9e5d5157, 0x2000, FLASH + 256 * k, 256, k, count, FAMILY];
    if (head.some((value, at) => value !== want[at]) || word(508) !== 0x0ab16f30) {
      throw new Error(`${path}: block ${k} is not what the boot ROM takes: ${head.map((v) => v.toString(16))}`);
    }
    parts.push(file.subarray(k * BLOCK + 32, k * BLOCK + 32 + 256));
  }
  return Buffer.concat(parts);
}

function romCrc(data) {
  let crc = 0xffffffff;
  for (const byte of data) {
    crc ^= byte << 24;
    for (let k = 0; k < 8; k++) crc = crc < 0 || crc >= 0x80000000 ? (crc << 1) ^ 0x04c11db7 : crc << 1;
  }
  return crc >>> 0;
}

// Checks the second stage, copies it to the top of the RAM and runs it from there until it enters the flash.
export function boot(rp2040, silicon, flash) {
  rp2040.flash.set(flash);
  const stage = flash.subarray(0, 256);
  const told = new DataView(stage.buffer, stage.byteOffset).getUint32(252, true);
  if (romCrc(stage.subarray(0, 252)) !== told) throw new Error('the boot ROM refuses boot2: wrong checksum');
  rp2040.sram.set(stage, BOOT2 - 0x20000000);
  const { core } = rp2040;
  core.SP = 0x20042000;
  core.LR = 0;
  core.PC = BOOT2;
  for (let k = 0; core.PC < FROM_FLASH || core.PC >= 0x20000000; k++) {
    if (k === BOOT2_STEPS) throw new Error('boot2 does not enter the flash');
    core.executeInstruction();
  }
  if (core.VTOR !== FROM_FLASH) throw new Error('boot2 does not set the vector table');
  silicon.requireMapped();
}
