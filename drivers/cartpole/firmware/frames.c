#include "cartpole.h"

#ifdef __AVR__
#include <util/crc16.h>
#define add_byte _crc_xmodem_update /* The same step in assembly: 16-bit shifts cost an AVR 4000 cycles for each frame. */
#else
/* Add a byte to a CRC of polynomial 0x1021, without a table. */
static uint16_t add_byte(uint16_t crc, uint8_t byte)
{
    crc = (uint16_t)((crc >> 8) | (crc << 8));
    crc ^= byte;
    crc ^= (uint8_t)(crc & 0xFF) >> 4;
    crc ^= (uint16_t)(crc << 12);
    return (uint16_t)(crc ^ (crc & 0xFF) << 5);
}
#endif

/* CRC-16/IBM-3740. */
uint16_t cartpole_crc(const uint8_t *data, uint8_t length)
{
    uint16_t crc = 0xFFFF;
    while (length--)
        crc = add_byte(crc, *data++);
    return crc;
}

uint8_t cartpole_frame(const uint8_t *payload, uint8_t length, uint8_t *frame)
{
    /* A frame has at most 63 bytes, so no COBS code reaches 0xFF. */
    uint16_t crc = cartpole_crc(payload, length);
    uint8_t code = 0, end = 1, i;
    for (i = 0; i < length + 2; i++) {
        uint8_t byte = i < length ? payload[i] : (uint8_t)(i == length ? crc : crc >> 8);
        if (byte == 0) {
            frame[code] = (uint8_t)(end - code);
            code = end++;
        } else {
            frame[end++] = byte;
        }
    }
    frame[code] = (uint8_t)(end - code);
    frame[end++] = 0;
    return end;
}

/* Undo COBS in place; return the length of the payload whose CRC was right, or 0. */
static uint8_t unwrap(uint8_t *block, uint8_t length)
{
    uint8_t from = 0, to = 0;
    if (length < 5)
        return 0;
    while (from < length) {
        uint8_t code = block[from++];
        if ((uint8_t)(code - 1) > (uint8_t)(length - from))
            return 0;
        for (; code > 1; code--)
            block[to++] = block[from++];
        if (from < length)
            block[to++] = 0;
    }
    if (to < 4)
        return 0;
    to = (uint8_t)(to - 2);
    return cartpole_crc(block, to) == (uint16_t)(block[to] | (uint16_t)(block[to + 1] << 8)) ? to : 0;
}

uint8_t cartpole_decode(cartpole_decoder *decoder, uint8_t byte)
{
    uint8_t length = decoder->length, payload = 0;
    if (byte != 0) {
        if (length < CARTPOLE_MAX_BLOCK)
            decoder->block[length] = byte;
        if (length <= CARTPOLE_MAX_BLOCK)
            decoder->length = (uint8_t)(length + 1);
        return 0;
    }
    if (length <= CARTPOLE_MAX_BLOCK)
        payload = unwrap(decoder->block, length);
    /* Bytes before the first delimiter are the end of an earlier frame. */
    if (payload == 0 && length > 0 && decoder->synchronised)
        decoder->errors++;
    decoder->synchronised = true;
    decoder->length = 0;
    return payload;
}
