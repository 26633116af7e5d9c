// A capture of the SPI pins as of a logic analyser. The emulator makes no edges of clock and data: they are
// written here from the clock and the time of each word, in mode 3.
import { openSync, writeSync } from 'node:fs';

const HEADER = `$timescale 1 ps $end
$scope module pins $end
$var wire 1 c cs $end
$var wire 1 k sclk $end
$var wire 1 o mosi $end
$var wire 1 i miso $end
$upscope $end
$enddefinitions $end
#0
1c
1k
0o
1i
`;

export class Vcd {
  constructor(path) {
    this.file = openSync(path, 'w');
    writeSync(this.file, HEADER);
  }

  // A frame with its words, from the fall of chip select to its rise.
  frame({ fall, words, reply }, rise) {
    const at = (ns) => `#${Math.round(ns * 1000)}\n`;
    let text = `${at(fall)}0c\n`;
    for (const { word, bits, start, hz } of words) {
      for (let k = 0; k < bits; k++) {
        const shift = bits - 1 - k;
        const begin = start + (k / hz) * 1e9;
        text += `${at(begin)}0k\n${(word >> shift) & 1}o\n${(reply >> shift) & 1}i\n`;
        text += `${at(begin + 0.5e9 / hz)}1k\n`;
      }
    }
    writeSync(this.file, `${text}${at(rise)}1c\n`);
  }
}
