#include "gonio_core.h"

#include <string.h>

#include "gonio_board.h"
#include "gonio_packet.h"

#define LARGER(a, b) ((a) > (b) ? (a) : (b))
#define BOARD_NAME_ROOM 24u
#define BODY(offset) (GP_HEADER_SIZE + (offset))

#define REQUEST_ROOM (BODY(GP_EXCHANGE_REQUEST_SIZE) + 2u * GONIO_MAX_FRAMES + GP_CRC_SIZE)
#define REPLY_ROOM                                                                                           \
    (GP_HEADER_SIZE + GP_CRC_SIZE + LARGER(2u * GONIO_MAX_FRAMES, GP_HELLO_REPLY_SIZE + BOARD_NAME_ROOM))
#define SCANS_ROOM (BODY(GP_SCANS_SIZE) + GONIO_MAX_SCAN_BYTES + GP_CRC_SIZE)
#define WIRE_OVERHEAD 2u

#define LEAST_PERIOD_US 100ul
#define LONGEST_PERIOD_US 1000000000ul
#define LEAST_LOW_US 10u
#define LONGEST_LOW_US 50000u
#define BYTES_A_POLL 16u

typedef char request_fits[REQUEST_ROOM <= GP_MAX_RAW ? 1 : -1];
typedef char list_fits[BODY(GP_STREAM_REQUEST_SIZE) + 2u * GONIO_MAX_LIST + GP_CRC_SIZE <= REQUEST_ROOM ? 1 : -1];
typedef char reply_fits[REPLY_ROOM <= GP_MAX_RAW ? 1 : -1];
typedef char statistics_fit[BODY(GP_STATISTICS_REPLY_SIZE) + GP_CRC_SIZE <= REPLY_ROOM ? 1 : -1];
typedef char scans_fit[SCANS_ROOM <= GP_MAX_RAW && GONIO_MAX_LIST * 2u <= GONIO_MAX_SCAN_BYTES ? 1 : -1];

/* -- state ---------------------------------------------------------------------------------------- */

static uint8_t request[REQUEST_ROOM];
static struct gonio_decoder decoder;
static uint8_t reply[REPLY_ROOM];
static uint8_t reply_length;
static const uint8_t *outgoing; /* sealed packet that waits for room, or NULL */
static uint8_t outgoing_length;

static struct {
    uint8_t open;
    uint32_t nonce;
    uint16_t last_id;
    uint32_t last_crc;
} session;

static struct {
    uint16_t packets, crc_errors, cobs_errors, length_errors, discarded, repeated;
    uint32_t frames;
} counts;

/* What the interrupt shares with the main loop. */
static volatile struct {
    uint8_t on_edges;  /* edges are triggers */
    uint8_t pending;   /* a trigger waits for its scan */
    uint8_t running;   /* a scan runs */
    uint8_t in_scan;   /* triggers since it began, 255 at most */
    uint32_t in_scan_us; /* time of the first of them */
    uint16_t decimation, skipped;
    uint32_t time_us;  /* of the newest trigger */
    uint32_t edges, lost;
} trigger;

static struct {
    uint8_t on;
    uint8_t by_period;
    uint8_t list_length;
    uint8_t scans_a_packet;
    uint16_t list[GONIO_MAX_LIST];
    uint32_t period_us, next_us;
    uint32_t lost_before; /* value of trigger.lost at the start */
    uint32_t lost_total;  /* of the last stream, once it is over */
    uint32_t sent;        /* scans taken in all */
    uint8_t packet[SCANS_ROOM];
    uint8_t filled;       /* bytes of scans in the packet */
    uint8_t scans;        /* scans in the packet */
    uint8_t closed;       /* the packet waits for room */
    uint32_t first_us, last_us;
    uint32_t packet_lost;
} stream;

/* -- frames: the only way to the chip --------------------------------------------------------------- */

static uint16_t frame(uint16_t word)
{
    counts.frames++;
    return board_frame(word);
}

/* -- replies ---------------------------------------------------------------------------------------- */

static void send_later(uint8_t *raw, uint8_t length)
{
    outgoing_length = gonio_seal(raw, length);
    outgoing = raw;
}

static void begin(uint8_t *raw, uint8_t type, uint16_t id)
{
    raw[0] = type;
    gonio_put16(raw + 1, id);
}

/* An error in `raw`; returns its length. */
static uint8_t refuse(uint8_t *raw, uint8_t type, uint16_t id, uint8_t code, uint16_t detail)
{
    begin(raw, GP_TYPE_ERROR, id);
    raw[BODY(GP_ERROR_REQUEST)] = type;
    raw[BODY(GP_ERROR_CODE)] = code;
    gonio_put16(raw + BODY(GP_ERROR_DETAIL), detail);
    return BODY(GP_ERROR_SIZE);
}

static uint8_t refuse_request(uint8_t code, uint16_t detail)
{
    return refuse(reply, request[0], gonio_get16(request + 1), code, detail);
}

/* -- triggers ----------------------------------------------------------------------------------------- */

/* From the interrupt, or locked. */
static void on_trigger(uint32_t time_us)
{
    if (++trigger.skipped < trigger.decimation) {
        return;
    }
    trigger.skipped = 0;
    trigger.time_us = time_us;
    if (trigger.running != 0u) {
        if (trigger.in_scan == 0u) {
            trigger.in_scan_us = time_us;
        }
        if (trigger.in_scan < 255u) {
            trigger.in_scan++;
        } else {
            trigger.lost++;
        }
    } else if (trigger.pending != 0u) {
        trigger.lost++;
    } else {
        trigger.pending = 1;
    }
}

void gonio_on_edge(uint32_t now_us)
{
    trigger.edges++;
    if (trigger.on_edges != 0u) {
        on_trigger(now_us);
    }
}

static void period_triggers(void)
{
    if (stream.on == 0u || stream.by_period == 0u) {
        return;
    }
    while ((int32_t)(board_now_us() - stream.next_us) >= 0) {
        board_lock();
        on_trigger(stream.next_us);
        board_unlock();
        stream.next_us += stream.period_us;
    }
}

static uint32_t lost_so_far(void)
{
    uint32_t lost;
    board_lock();
    lost = trigger.lost;
    board_unlock();
    return lost;
}

static void stop_triggers(void)
{
    board_lock();
    trigger.on_edges = 0;
    trigger.pending = 0;
    board_unlock();
    if (stream.on != 0u) {
        stream.lost_total = lost_so_far() - stream.lost_before;
    }
    stream.on = 0;
}

/* -- streams ------------------------------------------------------------------------------------------ */

static void close_packet(void)
{
    uint8_t *body = stream.packet + GP_HEADER_SIZE;
    gonio_put32(body + GP_SCANS_SEQUENCE, stream.sent - stream.scans);
    gonio_put16(body + GP_SCANS_LOST, (uint16_t)stream.packet_lost);
    gonio_put32(body + GP_SCANS_FIRST_US, stream.first_us);
    gonio_put32(body + GP_SCANS_SPAN_US, stream.last_us - stream.first_us);
    stream.closed = 1;
}

static void send_packet(void)
{
    uint8_t length = (uint8_t)(BODY(GP_SCANS_SIZE) + stream.filled);
    if (board_send_room() >= length + GP_CRC_SIZE + WIRE_OVERHEAD) {
        gonio_send(stream.packet, gonio_seal(stream.packet, length));
        stream.closed = 0;
        stream.filled = 0;
        stream.scans = 0;
    }
}

/* Send the list once; the words go behind those already in the packet, which is not longer for it yet. */
static void run_list(void)
{
    uint8_t *out = stream.packet + BODY(GP_SCANS_SIZE) + stream.filled;
    uint8_t k;
    (void)frame(stream.list[0]);
    for (k = 1; k <= stream.list_length; k++) {
        gonio_put16(out, frame(k < stream.list_length ? stream.list[k] : GP_IDLE_FRAME));
        out += 2;
    }
}

/* After a scan that took run_us since its trigger at time_us was taken up: 1 where it stands. It does not
 * where it saw another trigger only because it began late: then it may mix two updates. */
static uint8_t settle(uint32_t time_us, uint32_t run_us)
{
    uint8_t stands = 1;
    board_lock();
    trigger.running = 0;
    if (trigger.in_scan != 0u && trigger.in_scan_us - time_us > run_us) {
        stands = 0;
        trigger.pending = 1; /* the newest one */
    }
    trigger.lost += trigger.in_scan; /* with a torn scan: itself, and all but the newest */
    board_unlock();
    return stands;
}

static void scan(void)
{
    uint32_t time_us, lost, now_us;
    uint8_t pending;
    board_lock();
    pending = trigger.pending;
    time_us = trigger.time_us;
    lost = trigger.lost;
    board_unlock();
    if (pending == 0u || stream.closed != 0u) {
        return;
    }
    lost -= stream.lost_before;
    if (stream.scans != 0u && lost != stream.packet_lost) {
        close_packet(); /* scans of a packet are consecutive */
        return;
    }
    board_lock();
    if (time_us != trigger.time_us) { /* another one came meanwhile: look again */
        board_unlock();
        return;
    }
    trigger.pending = 0;
    trigger.running = 1;
    trigger.in_scan = 0;
    board_unlock();
    now_us = board_now_us();
    run_list();
    period_triggers();
    if (settle(time_us, board_now_us() - now_us) == 0u) {
        return;
    }
    if (stream.scans == 0u) {
        stream.first_us = time_us;
        stream.packet_lost = lost;
    }
    stream.last_us = time_us;
    stream.scans++;
    stream.sent++;
    stream.filled = (uint8_t)(stream.filled + 2u * stream.list_length);
    if (stream.scans == stream.scans_a_packet) {
        close_packet();
    }
}

/* -- requests: each gives the length of the reply that it made --------------------------------------------- */

/* Index of the fastest clock up to a limit; GP_CLOCKS where there is none. */
static uint8_t find_clock(uint32_t limit_hz)
{
    uint8_t k;
    for (k = 0; k < GP_CLOCKS; k++) {
        if (board_clocks_hz[k] != 0u && board_clocks_hz[k] <= limit_hz) {
            break;
        }
    }
    return k;
}

static uint8_t hello(void)
{
    uint8_t *body = reply + GP_HEADER_SIZE;
    uint8_t k;
    stop_triggers();
    stream.closed = 0;
    stream.filled = 0;
    stream.scans = 0;
    session.open = 1;
    session.nonce = gonio_get32(request + BODY(GP_HELLO_REQUEST_NONCE));
    board_set_timing(find_clock(GP_DEFAULT_CLOCK_HZ), GP_DEFAULT_STALL_US, GP_DEFAULT_PERIOD_US);
    body[GP_HELLO_REPLY_PROTOCOL] = GP_VERSION;
    body[GP_HELLO_REPLY_MAJOR] = GONIO_MAJOR;
    body[GP_HELLO_REPLY_MINOR] = GONIO_MINOR;
    body[GP_HELLO_REPLY_PATCH] = GONIO_PATCH;
    gonio_put16(body + GP_HELLO_REPLY_CAPABILITIES, (uint16_t)(GP_CAP_STREAM | board_capabilities));
    body[GP_HELLO_REPLY_MAX_FRAMES] = GONIO_MAX_FRAMES;
    body[GP_HELLO_REPLY_MAX_LIST] = GONIO_MAX_LIST;
    body[GP_HELLO_REPLY_MAX_SCAN_BYTES] = GONIO_MAX_SCAN_BYTES;
    gonio_put16(body + GP_HELLO_REPLY_MAX_WAIT_US, GONIO_MAX_WAIT_US);
    gonio_put32(body + GP_HELLO_REPLY_NOW_US, board_now_us());
    gonio_put32(body + GP_HELLO_REPLY_NONCE, session.nonce);
    for (k = 0; k < GP_CLOCKS; k++) {
        gonio_put32(body + GP_HELLO_REPLY_CLOCKS_HZ + 4u * k, board_clocks_hz[k]);
    }
    return (uint8_t)(BODY(GP_HELLO_REPLY_SIZE) + board_name(body + GP_HELLO_REPLY_BOARD, BOARD_NAME_ROOM));
}

static uint8_t configure(const uint8_t *body)
{
    uint8_t clock = find_clock(gonio_get32(body + GP_CONFIGURE_REQUEST_CLOCK_HZ));
    uint16_t stall_us = gonio_get16(body + GP_CONFIGURE_REQUEST_STALL_US);
    uint16_t period_us = gonio_get16(body + GP_CONFIGURE_REQUEST_PERIOD_US);
    if (clock == GP_CLOCKS) {
        return refuse_request(GP_ERROR_BAD_VALUE, GP_CONFIGURE_REQUEST_CLOCK_HZ);
    }
    if (stall_us > GONIO_MAX_WAIT_US) {
        return refuse_request(GP_ERROR_BAD_VALUE, GP_CONFIGURE_REQUEST_STALL_US);
    }
    if (period_us > GONIO_MAX_WAIT_US) {
        return refuse_request(GP_ERROR_BAD_VALUE, GP_CONFIGURE_REQUEST_PERIOD_US);
    }
    board_set_timing(clock, stall_us, period_us);
    gonio_put32(reply + BODY(GP_CONFIGURE_REPLY_CLOCK_HZ), board_clocks_hz[clock]);
    gonio_put16(reply + BODY(GP_CONFIGURE_REPLY_STALL_US), stall_us);
    gonio_put16(reply + BODY(GP_CONFIGURE_REPLY_PERIOD_US), period_us);
    return BODY(GP_CONFIGURE_REPLY_SIZE);
}

/* Index of the first frame that has one of the bits; count where none has. */
static uint8_t find_bits(const uint8_t *frames, uint8_t count, uint16_t bits)
{
    uint8_t k = 0;
    while (k < count && (gonio_get16(frames + 2u * k) & bits) == 0u) {
        k++;
    }
    return k;
}

static uint8_t exchange(const uint8_t *body, uint8_t length)
{
    const uint8_t *frames = body + GP_EXCHANGE_REQUEST_FRAMES;
    uint8_t bytes = (uint8_t)(length - GP_EXCHANGE_REQUEST_SIZE);
    uint8_t count = bytes / 2u;
    uint8_t writes = 0;
    uint8_t k;
    if (count == 0u || bytes % 2u != 0u || count > GONIO_MAX_FRAMES) {
        return refuse_request(GP_ERROR_BAD_LENGTH, count);
    }
    k = find_bits(frames, count, GP_RESERVED_BIT);
    if (k < count) {
        return refuse_request(GP_ERROR_BAD_FRAME, k);
    }
    for (k = 0; k < count; k++) {
        writes = (uint8_t)(writes + ((gonio_get16(frames + 2u * k) & GP_WRITE_BIT) != 0u));
    }
    if (writes != body[GP_EXCHANGE_REQUEST_WRITES]) {
        return refuse_request(GP_ERROR_WRITE_COUNT, writes);
    }
    for (k = 0; k < count; k++) {
        gonio_put16(reply + BODY(GP_EXCHANGE_REPLY_WORDS) + 2u * k, frame(gonio_get16(frames + 2u * k)));
    }
    return (uint8_t)(BODY(GP_EXCHANGE_REPLY_WORDS) + 2u * count);
}

static uint8_t start_stream(const uint8_t *body, uint8_t length)
{
    const uint8_t *frames = body + GP_STREAM_REQUEST_FRAMES;
    uint8_t bytes = (uint8_t)(length - GP_STREAM_REQUEST_SIZE);
    uint8_t count = bytes / 2u;
    uint8_t kind = body[GP_STREAM_REQUEST_TRIGGER];
    uint8_t scans = body[GP_STREAM_REQUEST_SCANS];
    uint16_t decimation = gonio_get16(body + GP_STREAM_REQUEST_DECIMATION);
    uint32_t period_us = gonio_get32(body + GP_STREAM_REQUEST_PERIOD_US);
    uint32_t now_us;
    uint8_t k;
    if (count == 0u || bytes % 2u != 0u || count > GONIO_MAX_LIST) {
        return refuse_request(GP_ERROR_BAD_LENGTH, count);
    }
    k = find_bits(frames, count, GP_RESERVED_BIT | GP_WRITE_BIT);
    if (k < count) {
        return refuse_request(GP_ERROR_BAD_FRAME, k);
    }
    if (kind > GP_TRIGGER_PERIOD) {
        return refuse_request(GP_ERROR_BAD_VALUE, GP_STREAM_REQUEST_TRIGGER);
    }
    if (scans == 0u || (uint16_t)(2u * scans * count) > GONIO_MAX_SCAN_BYTES) {
        return refuse_request(GP_ERROR_BAD_VALUE, GP_STREAM_REQUEST_SCANS);
    }
    if (decimation == 0u) {
        return refuse_request(GP_ERROR_BAD_VALUE, GP_STREAM_REQUEST_DECIMATION);
    }
    if (kind == GP_TRIGGER_PERIOD ? period_us < LEAST_PERIOD_US || period_us > LONGEST_PERIOD_US
                                  : period_us != 0u) {
        return refuse_request(GP_ERROR_BAD_VALUE, GP_STREAM_REQUEST_PERIOD_US);
    }
    for (k = 0; k < count; k++) {
        stream.list[k] = gonio_get16(frames + 2u * k);
    }
    stream.list_length = count;
    stream.scans_a_packet = scans;
    stream.filled = 0;
    stream.scans = 0;
    stream.sent = 0;
    stream.by_period = kind == GP_TRIGGER_PERIOD;
    stream.period_us = period_us;
    begin(stream.packet, GP_TYPE_SCANS, gonio_get16(request + 1));
    if (kind != GP_TRIGGER_PERIOD) {
        board_select_edge(kind == GP_TRIGGER_FALLING);
    }
    board_lock();
    trigger.pending = 0;
    trigger.running = 0;
    trigger.decimation = decimation;
    trigger.skipped = 0;
    stream.lost_before = trigger.lost;
    trigger.on_edges = kind != GP_TRIGGER_PERIOD;
    board_unlock();
    now_us = board_now_us();
    stream.next_us = now_us + period_us;
    stream.on = 1;
    gonio_put32(reply + BODY(GP_STREAM_REPLY_NOW_US), now_us);
    return BODY(GP_STREAM_REPLY_SIZE);
}

static uint8_t stop(void)
{
    stop_triggers();
    if (stream.scans != 0u && stream.closed == 0u) {
        close_packet();
    }
    gonio_put32(reply + BODY(GP_STOP_REPLY_SCANS), stream.sent);
    gonio_put32(reply + BODY(GP_STOP_REPLY_LOST), stream.lost_total);
    return BODY(GP_STOP_REPLY_SIZE);
}

static uint8_t reset(const uint8_t *body)
{
    uint16_t low_us = gonio_get16(body + GP_RESET_REQUEST_LOW_US);
    if (low_us < LEAST_LOW_US || low_us > LONGEST_LOW_US) {
        return refuse_request(GP_ERROR_BAD_VALUE, GP_RESET_REQUEST_LOW_US);
    }
    board_reset_chip(low_us);
    gonio_put32(reply + BODY(GP_RESET_REPLY_NOW_US), board_now_us());
    return BODY(GP_RESET_REPLY_SIZE);
}

static uint8_t statistics(void)
{
    uint8_t *body = reply + GP_HEADER_SIZE;
    uint32_t edges;
    board_lock();
    edges = trigger.edges;
    board_unlock();
    gonio_put32(body + GP_STATISTICS_REPLY_NOW_US, board_now_us());
    gonio_put32(body + GP_STATISTICS_REPLY_EDGES, edges);
    gonio_put32(body + GP_STATISTICS_REPLY_LOST, lost_so_far());
    gonio_put32(body + GP_STATISTICS_REPLY_FRAMES, counts.frames);
    gonio_put16(body + GP_STATISTICS_REPLY_PACKETS, counts.packets);
    gonio_put16(body + GP_STATISTICS_REPLY_CRC_ERRORS, counts.crc_errors);
    gonio_put16(body + GP_STATISTICS_REPLY_COBS_ERRORS, counts.cobs_errors);
    gonio_put16(body + GP_STATISTICS_REPLY_LENGTH_ERRORS, counts.length_errors);
    gonio_put16(body + GP_STATISTICS_REPLY_DISCARDED, counts.discarded);
    gonio_put16(body + GP_STATISTICS_REPLY_REPEATED, counts.repeated);
    gonio_put16(body + GP_STATISTICS_REPLY_RECEIVE_OVERRUNS, board_receive_overruns());
    return BODY(GP_STATISTICS_REPLY_SIZE);
}

/* A new request with a body of so many bytes. */
static uint8_t execute(uint8_t length)
{
    static const uint8_t least[] = {
        GP_HELLO_REQUEST_SIZE, GP_CONFIGURE_REQUEST_SIZE, GP_EXCHANGE_REQUEST_SIZE,   GP_STREAM_REQUEST_SIZE,
        GP_STOP_REQUEST_SIZE,  GP_RESET_REQUEST_SIZE,     GP_STATISTICS_REQUEST_SIZE,
    };
    const uint8_t *body = request + GP_HEADER_SIZE;
    uint8_t type = request[0];
    uint8_t has_tail = type == GP_TYPE_EXCHANGE_REQUEST || type == GP_TYPE_STREAM_REQUEST;
    uint8_t busy = stream.on != 0u || stream.closed != 0u;
    if (type < GP_TYPE_HELLO_REQUEST || type > GP_TYPE_STATISTICS_REQUEST) {
        return refuse_request(GP_ERROR_UNKNOWN_REQUEST, 0);
    }
    if (length < least[type - 1u] || (has_tail == 0u && length > least[type - 1u])) {
        return refuse_request(GP_ERROR_BAD_LENGTH, length);
    }
    begin(reply, type | GP_REPLY_BIT, gonio_get16(request + 1));
    switch (type) {
    case GP_TYPE_HELLO_REQUEST:
        return hello();
    case GP_TYPE_STOP_REQUEST:
        return stop();
    case GP_TYPE_STATISTICS_REQUEST:
        return statistics();
    default:
        break;
    }
    if (busy != 0u) {
        return refuse_request(GP_ERROR_BUSY, 0);
    }
    switch (type) {
    case GP_TYPE_CONFIGURE_REQUEST:
        return configure(body);
    case GP_TYPE_EXCHANGE_REQUEST:
        return exchange(body, length);
    case GP_TYPE_STREAM_REQUEST:
        return start_stream(body, length);
    default:
        return reset(body);
    }
}

/* A sound packet of so many bytes, CRC included, stands in `request`. */
static void take_packet(uint8_t length)
{
    uint8_t type = request[0];
    uint16_t id = gonio_get16(request + 1);
    uint8_t body_length = (uint8_t)(length - GP_HEADER_SIZE - GP_CRC_SIZE);
    uint32_t crc = gonio_get32(request + length - GP_CRC_SIZE);
    uint8_t fresh = 0;
    counts.packets++;
    if ((type & GP_REPLY_BIT) != 0u) {
        counts.discarded++;
        return;
    }
    if (type == GP_TYPE_HELLO_REQUEST) {
        const uint8_t *body = request + GP_HEADER_SIZE;
        if (body_length == 0u || body[GP_HELLO_REQUEST_PROTOCOL] != GP_VERSION) {
            send_later(request, refuse(request, type, id, GP_ERROR_PROTOCOL_VERSION, GP_VERSION));
            return;
        }
        if (body_length != GP_HELLO_REQUEST_SIZE) {
            send_later(request, refuse(request, type, id, GP_ERROR_BAD_LENGTH, body_length));
            return;
        }
        fresh = session.open == 0u || gonio_get32(body + GP_HELLO_REQUEST_NONCE) != session.nonce;
    } else if (session.open == 0u) {
        send_later(request, refuse(request, type, id, GP_ERROR_NO_SESSION, 0));
        return;
    }
    if (fresh == 0u) {
        uint16_t step = (uint16_t)(id - session.last_id);
        if (step >= 0x8000u) {
            counts.discarded++;
            return;
        }
        if (step == 0u && crc != session.last_crc) {
            send_later(request, refuse(request, type, id, GP_ERROR_ID_REUSED, 0));
            return;
        }
        if (step == 0u) {
            counts.repeated++;
            send_later(reply, reply_length);
            return;
        }
    }
    session.last_id = id;
    session.last_crc = crc;
    reply_length = execute(body_length);
    send_later(reply, reply_length);
}

/* 1 where bytes came in. */
static uint8_t receive(void)
{
    uint8_t left = BYTES_A_POLL;
    uint8_t took = 0;
    uint8_t byte;
    while (left-- > 0u && outgoing == NULL && board_receive(&byte) != 0u) {
        took = 1;
        switch (gonio_decode(&decoder, byte)) {
        case GONIO_PACKET:
            take_packet(decoder.length);
            break;
        case GONIO_BAD_COBS:
            counts.cobs_errors++;
            break;
        case GONIO_BAD_LENGTH:
            counts.length_errors++;
            break;
        case GONIO_BAD_CRC:
            counts.crc_errors++;
            break;
        case GONIO_MORE:
        default:
            break;
        }
    }
    return took;
}

/* -- public ------------------------------------------------------------------------------------------- */

void gonio_init(void)
{
    gonio_decoder_init(&decoder, request, REQUEST_ROOM);
    memset(&session, 0, sizeof session);
    memset(&counts, 0, sizeof counts);
    memset(&stream, 0, sizeof stream);
    board_lock();
    trigger.on_edges = 0;
    trigger.pending = 0;
    trigger.running = 0;
    trigger.in_scan = 0;
    trigger.decimation = 1;
    trigger.skipped = 0;
    trigger.edges = 0;
    trigger.lost = 0;
    board_unlock();
    outgoing = NULL;
    reply_length = 0;
    board_set_timing(find_clock(GP_DEFAULT_CLOCK_HZ), GP_DEFAULT_STALL_US, GP_DEFAULT_PERIOD_US);
    board_select_edge(0);
}

uint32_t gonio_poll(void)
{
    uint8_t took = 0;
    period_triggers();
    if (stream.on != 0u) {
        scan();
    }
    if (stream.closed != 0u) {
        send_packet(); /* before the reply: the last scans of a stream precede that of stop */
    } else if (outgoing != NULL) {
        if (board_send_room() >= outgoing_length + WIRE_OVERHEAD) {
            gonio_send(outgoing, outgoing_length);
            outgoing = NULL;
            took = 1;
        }
    } else {
        took = receive();
    }
    if (took != 0u || outgoing != NULL || stream.closed != 0u || trigger.pending != 0u) {
        return 0;
    }
    if (stream.on != 0u && stream.by_period != 0u) {
        int32_t left_us = (int32_t)(stream.next_us - board_now_us());
        return left_us > 0 ? (uint32_t)left_us : 0u;
    }
    return GONIO_IDLE;
}
