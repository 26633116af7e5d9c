// The controller's device mode as its data sheet has it (RP2040, 4.1), and a host that enumerates a board and
// opens its serial port as Linux does. rp2040js' own controller ends every IN transfer at once and knows no
// toggles, no NAK and no STALL, so it could neither see a missing empty packet nor a slow host; its registers
// stay, its buffers are replaced here.
import { USBCDC } from 'rp2040js';

const AVAILABLE = 1 << 10;
const STALL = 1 << 11;
const DATA1 = 1 << 13;
const FULL = 1 << 15;
const LENGTH = 0x3ff;
const PULL_UP = 1 << 16;
const SETUP_RECEIVED = 1 << 17;
const BUS_RESET = 1 << 19;
const DATA_SEQUENCE_ERROR = 1 << 31;
const IN = 0;
const OUT = 1;

const SLOT_NS = 60e3; // a transaction of 64 bytes and its gaps at 12 Mbit/s
const MS = 1e6;
const DEADLINE_NS = 500 * MS;
// clk_usb is slower than clk_sys: three of its cycles lie between a buffer's content and AVAILABLE.
const CYCLES_BEFORE_AVAILABLE = 8;
const URB = 128; // Linux' cdc_acm reads two packets at a time, or up to a short one

// Erratum E15: what is offered to the host so late in a frame may hang the controller.
const LATE_NS = 0.82 * MS;

// A start of frame each millisecond, which reading the frame's number acknowledges.
class Frames {
  constructor(rp2040) {
    const { usbCtrl: usb, clock } = rp2040;
    this.begunNs = 0;
    const read = usb.readUint32.bind(usb);
    usb.readUint32 = (offset) => {
      if (offset === 0x48) {
        usb.intRaw &= ~(1 << 17);
        usb.checkInterrupts();
      }
      return read(offset);
    };
    const alarm = clock.createAlarm(() => {
      this.begunNs = clock.nanos;
      usb.sofFrameNumber = (usb.sofFrameNumber + 1) & 0x7ff;
      if (usb.sieCtrl & PULL_UP) usb.intRaw |= 1 << 17;
      usb.checkInterrupts();
      alarm.schedule(MS);
    });
    alarm.schedule(MS);
  }
}

class Stalled extends Error {}

export class UsbHost {
  arrived = [];
  sending = [];
  info = null;
  plugged = true;
  inEvery = 1; // slots; larger for a slow host
  transactions = 0;

  constructor(rp2040, silicon) {
    this.rp2040 = rp2040;
    this.usb = rp2040.usbCtrl;
    this.view = rp2040.usbDPRAMView;
    this.silicon = silicon;
    this.shadow = new Uint32Array(32);
    this.written = new Float64Array(32);
    this.muxing = 0;
    this.address = 0;
    this.urb = [];
    this.script = this.enumerate();
    this.busFrames = new Frames(rp2040);
    this.usb.onUSBEnabled = () => {};
    this.usb.onResetReceived = () => {};
    this.usb.DPRAMUpdated = (offset, value) => this.onMemory(offset, value);
    const write = this.usb.writeUint32.bind(this.usb);
    this.usb.writeUint32 = (offset, value) => {
      if (offset === 0x74) this.muxing = value;
      else if (offset === 0x68) this.usb.epStallArm = value;
      else write(offset, value);
    };
    this.alarm = rp2040.clock.createAlarm(() => this.slot());
    this.alarm.schedule(SLOT_NS);
  }

  fault(text) {
    this.silicon.fault(`USB: ${text}`);
  }

  // -- the controller's buffers --------------------------------------------------------------------

  onMemory(offset, value) {
    if (this.silicon.resets.value & (1 << 24)) this.fault('the memory is used while the controller is in reset');
    if (offset < 0x80 || offset >= 0x100) return;
    const at = (offset - 0x80) >> 2;
    const { cycles } = this.rp2040.core;
    const before = this.shadow[at];
    if (value & AVAILABLE && this.ends && at === 2 * this.ends.in && this.now - this.busFrames.begunNs > LATE_NS) {
      this.fault('data are offered late in a frame (erratum E15)');
    }
    if (value & AVAILABLE && !(before & AVAILABLE)) {
      if ((value & ~AVAILABLE) >>> 0 !== before) this.fault('AVAILABLE is written together with the rest');
      else if (cycles - this.written[at] < CYCLES_BEFORE_AVAILABLE) this.fault('AVAILABLE is written too soon');
    }
    this.shadow[at] = value;
    this.written[at] = cycles;
  }

  control(endpoint, way) {
    return this.shadow[2 * endpoint + way];
  }

  setControl(endpoint, way, value) {
    this.shadow[2 * endpoint + way] = value;
    this.view.setUint32(0x80 + 8 * endpoint + 4 * way, value, true);
  }

  bufferOf(endpoint, way) {
    if (endpoint === 0) return 0x100;
    const control = this.view.getUint32(8 * endpoint + 4 * way, true);
    if (!(control & (1 << 31))) this.fault(`endpoint ${endpoint} is used, but not enabled`);
    if (!(control & (1 << 29))) this.fault(`endpoint ${endpoint} gives no interrupts`);
    return control & 0xffc0;
  }

  tell(endpoint, way) {
    if (endpoint === 0 && !(this.usb.sieCtrl & (1 << 29))) this.fault('endpoint 0 gives no interrupts');
    this.usb.buffStatus |= 1 << (2 * endpoint + way);
    this.usb.buffStatusUpdated();
  }

  stalled(endpoint, way) {
    if (!(this.control(endpoint, way) & STALL)) return false;
    return endpoint !== 0 || Boolean(this.usb.epStallArm & (1 << way));
  }

  answers() {
    this.transactions++;
    if ((this.usb.addrEndp & 0x7f) !== this.address) throw new Error(`no answer at address ${this.address}`);
  }

  // One IN transaction: {pid, data}, 'NAK' or 'STALL'.
  tryIn(endpoint) {
    this.answers();
    const control = this.control(endpoint, IN);
    if (this.stalled(endpoint, IN)) return 'STALL';
    if (!(control & AVAILABLE)) return 'NAK';
    if (!(control & FULL)) this.fault(`endpoint ${endpoint} sends a buffer that is not marked full`);
    const from = this.bufferOf(endpoint, IN);
    const data = this.rp2040.usbDPRAM.slice(from, from + (control & LENGTH));
    this.setControl(endpoint, IN, control & ~(AVAILABLE | FULL));
    this.tell(endpoint, IN);
    return { pid: control & DATA1 ? 1 : 0, data };
  }

  // One OUT transaction: true, 'NAK' or 'STALL'.
  tryOut(endpoint, data, pid) {
    this.answers();
    const control = this.control(endpoint, OUT);
    if (this.stalled(endpoint, OUT)) return 'STALL';
    if (!(control & AVAILABLE)) return 'NAK';
    if ((control & DATA1 ? 1 : 0) !== pid) {
      this.usb.sieStatus |= DATA_SEQUENCE_ERROR;
      this.fault(`endpoint ${endpoint} expects the other toggle: the packet is lost`);
      return true;
    }
    if (data.length > (control & LENGTH)) this.fault(`endpoint ${endpoint} has no room for ${data.length} bytes`);
    this.rp2040.usbDPRAM.set(data, this.bufferOf(endpoint, OUT));
    this.setControl(endpoint, OUT, (control & ~(AVAILABLE | LENGTH)) | FULL | data.length);
    this.tell(endpoint, OUT);
    return true;
  }

  sendSetup(bytes) {
    this.answers();
    this.usb.epStallArm = 0;
    this.rp2040.usbDPRAM.set(bytes, 0);
    this.usb.sieStatus |= SETUP_RECEIVED;
    this.usb.sieStatusUpdated();
  }

  // -- the host: scripts yield the time until their next step ------------------------------------------

  get now() {
    return this.rp2040.clock.nanos;
  }

  get attached() {
    const { mainCtrl, sieCtrl, usbPwr } = this.usb;
    return mainCtrl === 1 && (sieCtrl & PULL_UP) !== 0 && this.muxing === 9 && (usbPwr & 0xc) === 0xc;
  }

  *until(attempt) {
    const end = this.now + DEADLINE_NS;
    for (;;) {
      const answer = attempt();
      yield SLOT_NS;
      if (answer === 'STALL') throw new Stalled();
      if (answer !== 'NAK') return answer;
      if (this.now > end) throw new Error('no answer to a control transfer within 0.5 s');
    }
  }

  *transfer(type, request, value, index, length, out = []) {
    this.sendSetup([type, request, value & 255, value >> 8, index & 255, index >> 8, length & 255, length >> 8]);
    yield SLOT_NS;
    const data = [];
    let pid = 1;
    const packet = function* (host) {
      const got = yield* host.until(() => host.tryIn(0));
      if (got.pid !== pid) host.fault('a control transfer has the wrong toggle');
      pid ^= 1;
      return got.data;
    };
    if (type & 0x80) {
      let part;
      do {
        part = yield* packet(this);
        data.push(...part);
      } while (part.length === 64 && data.length < length);
      yield* this.until(() => this.tryOut(0, [], 1));
    } else {
      if (out.length) yield* this.until(() => this.tryOut(0, out, 1));
      pid = 1;
      if ((yield* packet(this)).length) this.fault('the end of a control transfer is not empty');
    }
    return data;
  }

  *reset() {
    this.address = 0;
    this.usb.sieStatus |= BUS_RESET;
    this.usb.sieStatusUpdated();
    yield 10 * MS;
  }

  *text(index) {
    if (!index) return '';
    const data = yield* this.transfer(0x80, 6, 0x0300 | index, 0x0409, 255);
    if (data[0] !== data.length || data[1] !== 3) this.fault(`string ${index} has a wrong length`);
    return Buffer.from(data.slice(2)).toString('utf16le');
  }

  *enumerate() {
    while (!this.attached) yield MS;
    yield 20 * MS; // Linux waits 100 ms until the contacts are quiet
    yield* this.reset();
    const first = yield* this.transfer(0x80, 6, 0x0100, 0, 64);
    if (first.length !== 18 || first[7] !== 64) throw new Error('no sound device descriptor');
    yield* this.reset();
    yield* this.transfer(0x00, 5, 7, 0, 0);
    yield 2 * MS;
    this.address = 7;
    const device = yield* this.transfer(0x80, 6, 0x0100, 0, 18);
    const refused = yield* this.refusal(0x80, 6, 0x0600, 0, 10); // a full-speed device has no qualifier
    if (!refused) this.fault('a qualifier is described');
    const head = yield* this.transfer(0x80, 6, 0x0200, 0, 9);
    const whole = yield* this.transfer(0x80, 6, 0x0200, 0, head[2] | (head[3] << 8));
    if (whole.length !== (head[2] | (head[3] << 8))) this.fault('the configuration has a wrong length');
    const languages = yield* this.transfer(0x80, 6, 0x0300, 0, 255);
    if (String(languages) !== '4,3,9,4') this.fault('no language');
    this.info = {
      vid: device[8] | (device[9] << 8),
      pid: device[10] | (device[11] << 8),
      manufacturer: yield* this.text(device[14]),
      product: yield* this.text(device[15]),
      serial_number: yield* this.text(device[16]),
    };
    const ends = parse(whole, (text) => this.fault(text));
    yield* this.transfer(0x00, 9, whole[5], 0, 0);
    this.toggles = { in: 0, out: 0 };
    yield* this.setLine(9600, ends);
    this.info.endpoints = ends;
    this.ends = ends; // from now on data go both ways
  }

  // What a tty's opening does. Coding and line state must come back as they were set.
  *setLine(baud, ends = this.ends) {
    const coding = [baud & 255, (baud >> 8) & 255, (baud >> 16) & 255, baud >>> 24, 0, 0, 8];
    yield* this.transfer(0x21, 0x20, 0, ends.notices, 7, coding);
    const back = yield* this.transfer(0xa1, 0x21, 0, ends.notices, 7);
    if (String(back) !== String(coding)) this.fault(`line coding ${coding} comes back as ${back}`);
    yield* this.transfer(0x21, 0x22, 3, ends.notices, 0);
  }

  *refusal(...request) {
    try {
      yield* this.transfer(...request);
      return false;
    } catch (error) {
      if (!(error instanceof Stalled)) throw error;
      return true;
    }
  }

  // Both ends' toggles begin anew, as after an error on the bus.
  *clearHalt() {
    yield* this.transfer(0x02, 1, 0, this.ends.out, 0);
    this.toggles.out = 0;
    yield* this.transfer(0x02, 1, 0, 0x80 | this.ends.in, 0);
    this.toggles.in = 0;
  }

  start(script) {
    this.script = script;
  }

  slot() {
    let wait = SLOT_NS;
    if (this.plugged) {
      if (this.script) {
        const { done, value } = this.script.next();
        if (done) this.script = null;
        else wait = value;
      } else this.exchange();
    }
    this.alarm.schedule(wait);
  }

  exchange() {
    this.turn = (this.turn ?? 0) + 1;
    if (this.sending.length && this.turn % 2) this.sendData();
    else if (this.turn % this.inEvery === 0) this.fetchData();
  }

  sendData() {
    const part = this.sending.slice(0, 64);
    const answer = this.tryOut(this.ends.out, part, this.toggles.out);
    if (answer !== true) return;
    this.toggles.out ^= 1;
    this.sending.splice(0, part.length);
  }

  fetchData() {
    const got = this.tryIn(this.ends.in);
    if (got === 'NAK') return;
    if (got.pid !== this.toggles.in) {
      this.fault('a packet to the host has the wrong toggle: it is thrown away');
      return;
    }
    this.toggles.in ^= 1;
    this.urb.push(...got.data);
    if (got.data.length < 64 || this.urb.length === URB) {
      this.arrived.push(...this.urb);
      this.urb = [];
    }
  }
}

// The host that comes with rp2040js, on its own controller: less strict, but written by others.
export class StockHost {
  arrived = [];
  plugged = true;
  info = null;

  constructor(rp2040) {
    this.busFrames = new Frames(rp2040);
    this.port = new USBCDC(rp2040.usbCtrl);
    this.port.onSerialData = (data) => this.arrived.push(...data);
    this.sending = { push: (...bytes) => bytes.forEach((byte) => this.port.sendSerialByte(byte)) };
  }
}

// Endpoints of a CDC-ACM function, from its configuration descriptor; breaches of the standard are told.
function parse(data, fault) {
  const ends = {};
  let kind = 0;
  let interfaces = 0;
  for (let at = 0; at < data.length; at += data[at]) {
    if (!data[at]) throw new Error('a descriptor of length 0');
    const field = (offset) => data[at + offset];
    if (field(1) === 4) {
      kind = field(5);
      interfaces++;
      if (kind === 2) ends.notices = field(2);
      if (kind === 2 && (field(6) !== 2 || field(7) !== 0)) fault('not an ACM function without AT commands');
    }
    if (field(1) === 5) {
      const [address, type, size] = [field(2), field(3), field(4) | (field(5) << 8)];
      if (kind === 10 && (type !== 2 || size !== 64)) fault(`endpoint ${address} is not bulk of 64 bytes`);
      if (kind === 10) ends[address & 0x80 ? 'in' : 'out'] = address & 15;
    }
  }
  if (interfaces !== data[4]) fault('the number of interfaces is wrong');
  if (!ends.in || !ends.out) throw new Error('no data endpoints');
  return ends;
}
