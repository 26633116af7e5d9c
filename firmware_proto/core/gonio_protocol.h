/* Generated from firmware_proto/protocol.toml by scripts/generate_protocol.py; do not edit. */
#ifndef GONIO_PROTOCOL_H
#define GONIO_PROTOCOL_H

#define GP_VERSION 1u
#define GP_BAUD 500000ul
#define GP_BAUD_FAST 1000000ul

#define GP_HEADER_SIZE 3u
#define GP_CRC_SIZE 4u
#define GP_MAX_RAW 252u
#define GP_CRC_INITIAL 0xFFFFFFFFul /* CRC-32/ISO-HDLC */
#define GP_CRC_FINAL 0xFFFFFFFFul
#define GP_DELIMITER 0x00u
#define GP_REPLY_BIT 0x80u

#define GP_CLOCKS 6u
#define GP_WRITE_BIT 0x8000u
#define GP_RESERVED_BIT 0x4000u
#define GP_IDLE_FRAME 0x0000u
#define GP_RETRY_MS 250u

#define GP_DEFAULT_CLOCK_HZ 250000ul
#define GP_DEFAULT_STALL_US 75ul
#define GP_DEFAULT_PERIOD_US 160ul

#define GP_CAP_STREAM 0x0001u /* runs a list of read frames by itself */
#define GP_CAP_DATA_READY 0x0002u /* can trigger on data-ready edges and counts them */
#define GP_CAP_HARD_RESET 0x0004u /* drives the chip's RST line */
#define GP_CAP_USB 0x0008u /* is a USB device itself: there is no baud rate */

#define GP_TRIGGER_RISING 0u /* rising edge of data-ready */
#define GP_TRIGGER_FALLING 1u /* falling edge of data-ready */
#define GP_TRIGGER_PERIOD 2u /* the firmware's own clock, every period_us */

#define GP_ERROR_NO_SESSION 1u /* no hello since power-on: the firmware restarted */
#define GP_ERROR_UNKNOWN_REQUEST 2u /* no such request */
#define GP_ERROR_BAD_LENGTH 3u /* the body's length does not fit the request */
#define GP_ERROR_BUSY 4u /* a stream is running; stop it first */
#define GP_ERROR_BAD_FRAME 5u /* bit 14 set, or the write bit in a stream's list; detail is the frame's index */
#define GP_ERROR_WRITE_COUNT 6u /* the count of write frames does not fit the frames; detail is their number */
#define GP_ERROR_BAD_VALUE 7u /* a value is out of range; detail is the offset of its field */
#define GP_ERROR_ID_REUSED 8u /* the id of the last request with another content */
#define GP_ERROR_PROTOCOL_VERSION 9u /* another protocol version; detail is the firmware's */

/* hello_request: Opens a session: stops a stream, sets the default timing, forgets the ids used before. */
#define GP_TYPE_HELLO_REQUEST 0x01u
#define GP_HELLO_REQUEST_PROTOCOL 0u /* u8: version that the host speaks */
#define GP_HELLO_REQUEST_NONCE 1u /* u32: random number that the host draws for each session */
#define GP_HELLO_REQUEST_SIZE 5u /* without a tail */

/* hello_reply: Reply to the request hello. */
#define GP_TYPE_HELLO_REPLY 0x81u
#define GP_HELLO_REPLY_PROTOCOL 0u /* u8: version that the firmware speaks */
#define GP_HELLO_REPLY_MAJOR 1u /* u8: firmware version */
#define GP_HELLO_REPLY_MINOR 2u /* u8: firmware version */
#define GP_HELLO_REPLY_PATCH 3u /* u8: firmware version */
#define GP_HELLO_REPLY_CAPABILITIES 4u /* u16: bits of [capabilities] */
#define GP_HELLO_REPLY_MAX_FRAMES 6u /* u8: frames in an exchange, at most */
#define GP_HELLO_REPLY_MAX_LIST 7u /* u8: frames in a stream's list, at most */
#define GP_HELLO_REPLY_MAX_SCAN_BYTES 8u /* u8: bytes of scans in a stream packet, at most */
#define GP_HELLO_REPLY_MAX_WAIT_US 9u /* u16: longest stall and period that can be configured */
#define GP_HELLO_REPLY_NOW_US 11u /* u32: firmware's clock, wraps */
#define GP_HELLO_REPLY_NONCE 15u /* u32: the request's nonce */
#define GP_HELLO_REPLY_CLOCKS_HZ 19u /* u32[6]: SPI clocks, fastest first, 0 where unused */
#define GP_HELLO_REPLY_BOARD 43u /* text: board, a blank, serial number; the board alone if it has none */
#define GP_HELLO_REPLY_SIZE 43u /* without a tail */

/* configure_request: Sets the SPI timing. It takes the fastest clock not above clock_hz, or fails with bad_value. */
#define GP_TYPE_CONFIGURE_REQUEST 0x02u
#define GP_CONFIGURE_REQUEST_CLOCK_HZ 0u /* u32: highest clock */
#define GP_CONFIGURE_REQUEST_STALL_US 4u /* u16: least time of chip select high */
#define GP_CONFIGURE_REQUEST_PERIOD_US 6u /* u16: least time from frame start to frame start */
#define GP_CONFIGURE_REQUEST_SIZE 8u /* without a tail */

/* configure_reply: Reply to the request configure. */
#define GP_TYPE_CONFIGURE_REPLY 0x82u
#define GP_CONFIGURE_REPLY_CLOCK_HZ 0u /* u32: clock in force */
#define GP_CONFIGURE_REPLY_STALL_US 4u /* u16: stall in force */
#define GP_CONFIGURE_REPLY_PERIOD_US 6u /* u16: period in force */
#define GP_CONFIGURE_REPLY_SIZE 8u /* without a tail */

/* exchange_request: Sends frames; the reply has as many words. All are executed, or none if it is refused. */
#define GP_TYPE_EXCHANGE_REQUEST 0x03u
#define GP_EXCHANGE_REQUEST_WRITES 0u /* u8: how many of the frames have the write bit */
#define GP_EXCHANGE_REQUEST_FRAMES 1u /* words: 1 to max_frames frames */
#define GP_EXCHANGE_REQUEST_SIZE 1u /* without a tail */

/* exchange_reply: Reply to the request exchange. */
#define GP_TYPE_EXCHANGE_REPLY 0x83u
#define GP_EXCHANGE_REPLY_WORDS 0u /* words: word shifted out during each frame */
#define GP_EXCHANGE_REPLY_SIZE 0u /* without a tail */

/* stream_request: Starts a stream; its packets carry this request's id. */
#define GP_TYPE_STREAM_REQUEST 0x04u
#define GP_STREAM_REQUEST_TRIGGER 0u /* u8: code of [triggers] */
#define GP_STREAM_REQUEST_SCANS 1u /* u8: scans in a packet, at least 1 */
#define GP_STREAM_REQUEST_DECIMATION 2u /* u16: every n-th trigger gives a scan, at least 1 */
#define GP_STREAM_REQUEST_PERIOD_US 4u /* u32: for the trigger `period`, else 0 */
#define GP_STREAM_REQUEST_FRAMES 8u /* words: 1 to max_list read frames */
#define GP_STREAM_REQUEST_SIZE 8u /* without a tail */

/* stream_reply: Reply to the request stream. */
#define GP_TYPE_STREAM_REPLY 0x84u
#define GP_STREAM_REPLY_NOW_US 0u /* u32: firmware's clock at the start */
#define GP_STREAM_REPLY_SIZE 4u /* without a tail */

/* stop_request: Ends the stream; its last scans come before the reply. If none runs, the last totals come. */
#define GP_TYPE_STOP_REQUEST 0x05u
#define GP_STOP_REQUEST_SIZE 0u /* without a tail */

/* stop_reply: Reply to the request stop. */
#define GP_TYPE_STOP_REPLY 0x85u
#define GP_STOP_REPLY_SCANS 0u /* u32: scans sent in all */
#define GP_STOP_REPLY_LOST 4u /* u32: triggers that gave no scan */
#define GP_STOP_REPLY_SIZE 8u /* without a tail */

/* reset_request: Pulls the chip's RST line low; the host waits for the start-up. */
#define GP_TYPE_RESET_REQUEST 0x06u
#define GP_RESET_REQUEST_LOW_US 0u /* u16: time low, 10 to 50000 */
#define GP_RESET_REQUEST_SIZE 2u /* without a tail */

/* reset_reply: Reply to the request reset. */
#define GP_TYPE_RESET_REPLY 0x86u
#define GP_RESET_REPLY_NOW_US 0u /* u32: firmware's clock at the release */
#define GP_RESET_REPLY_SIZE 4u /* without a tail */

/* statistics_request: Reads the counters since power-on, which wrap and are never reset, and changes nothing. */
#define GP_TYPE_STATISTICS_REQUEST 0x07u
#define GP_STATISTICS_REQUEST_SIZE 0u /* without a tail */

/* statistics_reply: Reply to the request statistics. */
#define GP_TYPE_STATISTICS_REPLY 0x87u
#define GP_STATISTICS_REPLY_NOW_US 0u /* u32: firmware's clock, wraps */
#define GP_STATISTICS_REPLY_EDGES 4u /* u32: data-ready edges */
#define GP_STATISTICS_REPLY_LOST 8u /* u32: triggers that gave no scan, all streams */
#define GP_STATISTICS_REPLY_FRAMES 12u /* u32: frames sent to the chip */
#define GP_STATISTICS_REPLY_PACKETS 16u /* u16: sound packets received */
#define GP_STATISTICS_REPLY_CRC_ERRORS 18u /* u16: packets with a wrong CRC */
#define GP_STATISTICS_REPLY_COBS_ERRORS 20u /* u16: packets with broken COBS */
#define GP_STATISTICS_REPLY_LENGTH_ERRORS 22u /* u16: packets too short or too long */
#define GP_STATISTICS_REPLY_DISCARDED 24u /* u16: sound packets thrown away: stale id or not a request */
#define GP_STATISTICS_REPLY_REPEATED 26u /* u16: requests answered from memory */
#define GP_STATISTICS_REPLY_RECEIVE_OVERRUNS 28u /* u16: bytes lost in the receiver */
#define GP_STATISTICS_REPLY_SIZE 30u /* without a tail */

/* scans: Scans of consecutive triggers; the id is the id of the request that started the stream. */
#define GP_TYPE_SCANS 0xC4u
#define GP_SCANS_SEQUENCE 0u /* u32: scans sent in this stream before the first one here, wraps */
#define GP_SCANS_LOST 4u /* u16: triggers lost in this stream before the first scan here, wraps */
#define GP_SCANS_FIRST_US 6u /* u32: time of the first scan's trigger */
#define GP_SCANS_SPAN_US 10u /* u32: time from the first scan's trigger to the last one's */
#define GP_SCANS_WORDS 14u /* words: reply to each frame of the list, scan by scan */
#define GP_SCANS_SIZE 14u /* without a tail */

/* error: Reply to a refused request: nothing was executed. */
#define GP_TYPE_ERROR 0xFFu
#define GP_ERROR_REQUEST 0u /* u8: the request's type */
#define GP_ERROR_CODE 1u /* u8: code of [errors] */
#define GP_ERROR_DETAIL 2u /* u16: see [errors] */
#define GP_ERROR_SIZE 4u /* without a tail */

#endif
