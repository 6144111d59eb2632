/* opc4.h: the contract of a firmware in C with opc4-sil. Made by `opc4 firmware --new`; not to be edited.
 *
 * A firmware defines fw_init and fw_step. fw_init is called once, fw_step once a period. Before each
 * call fw_in holds the settings, the time and the frames that arrived, and fw_out is empty; after it
 * fw_out holds the frames to send. Numbers are in SI units. Of a libc there are memcpy and memset.
 * Compile with -ffp-contract=off: then every machine computes the same bits. */
#ifndef OPC4_H
#define OPC4_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define OPC4_MAX_ARRIVED 1024
#define OPC4_MAX_SENT 160 /* what a bus of 1 Mbit/s carries in the longest period */
#define OPC4_MAX_SIGNALS 32

void *memcpy(void *to, const void *from, size_t size);
void *memset(void *to, int value, size_t size);

struct opc4_frame {
    int64_t time_ns; /* of arrival */
    uint8_t data[8];
    uint32_t id; /* 29 bits */
    uint8_t length;
};

struct opc4_signal {
    double value;
    const char *name;
};

@SETTINGS@
struct opc4_in {
    struct opc4_settings settings;
    int64_t now_ns; /* since the run began */
    uint32_t count;
    uint32_t lost; /* frames that did not fit since the run began, the oldest ones */
    struct opc4_frame frames[OPC4_MAX_ARRIVED]; /* in order of arrival */
};

struct opc4_out {
    uint32_t count;
    uint32_t signal_count;
    struct opc4_frame frames[OPC4_MAX_SENT]; /* in the order in which they are to be sent */
    struct opc4_signal signals[OPC4_MAX_SIGNALS]; /* for firmware.csv */
    const char *failure; /* why the firmware cannot go on; NULL while it can */
    const char *file;
    uint32_t line;
};

extern struct opc4_in fw_in;
extern struct opc4_out fw_out;
extern const uint32_t fw_contract;
__attribute__((weak)) struct opc4_in fw_in;
__attribute__((weak)) struct opc4_out fw_out;
__attribute__((weak)) const uint32_t fw_contract = @CONTRACT@u;

void fw_init(void);
void fw_step(void);

/* --- what a firmware says beside its frames --- */

/* End the run with exit code 3 and this text. */
#define opc4_fail(text) opc4_fail_at((text), __FILE__, __LINE__)
static inline void opc4_fail_at(const char *text, const char *file, uint32_t line)
{
    if (fw_out.failure == NULL) {
        fw_out.failure = text;
        fw_out.file = file;
        fw_out.line = line;
    }
}

/* Write a value into firmware.csv. */
static inline void opc4_trace(const char *name, double value)
{
    if (fw_out.signal_count < OPC4_MAX_SIGNALS) {
        fw_out.signals[fw_out.signal_count].name = name;
        fw_out.signals[fw_out.signal_count].value = value;
        fw_out.signal_count++;
    }
}

/* Queue a frame; one that is none, and more than a bus takes, end the run. */
#define opc4_send(frame) opc4_send_at((frame), __FILE__, __LINE__)
static inline void opc4_send_at(const struct opc4_frame *frame, const char *file, uint32_t line)
{
    if (frame->length > 8 || frame->id >= 1u << 29)
        opc4_fail_at("frame of more than 8 bytes, or an identifier of more than 29 bits", file, line);
    else if (fw_out.count == OPC4_MAX_SENT)
        opc4_fail_at("more frames in a step than a bus takes", file, line);
    else
        fw_out.frames[fw_out.count++] = *frame;
}

/* --- numbers and bits --- */

/* Round to a whole number, ties to even; for sizes below 2^51. */
static inline double opc4_round(double value)
{
    return (value + 6755399441055744.0) - 6755399441055744.0; /* 1.5 * 2^52 leaves no fraction */
}

/* Seconds as nanoseconds. */
static inline int64_t opc4_ns(double seconds)
{
    return (int64_t)opc4_round(seconds * 1e9);
}

static inline bool opc4_is_within(int32_t raw, int32_t low, int32_t high)
{
    return low <= raw && raw <= high;
}

static inline int32_t opc4_signed(int32_t raw, int32_t mask)
{
    return raw > mask >> 1 ? raw - mask - 1 : raw;
}

static inline bool opc4_put_number(uint64_t *word, double value, double by, double to_si, double offset,
                                   double factor, double low, double high, uint32_t mask, unsigned start)
{
    const double raw = opc4_round((value * by / to_si - offset) / factor);
    if (!(low <= raw && raw <= high)) /* also for NaN */
        return false;
    *word |= ((uint64_t)(int64_t)raw & mask) << start;
    return true;
}

static inline bool opc4_put_whole(uint64_t *word, int32_t value, int32_t low, int32_t high, int32_t offset,
                                  unsigned start)
{
    if (!opc4_is_within(value, low, high))
        return false;
    *word |= (uint64_t)(uint32_t)(value - offset) << start;
    return true;
}

static inline bool opc4_put_text(uint64_t *word, const char text[2], unsigned start)
{
    const uint8_t first = (uint8_t)text[0], second = (uint8_t)text[1];
    *word |= (uint64_t)((uint32_t)first | (uint32_t)second << 8) << start;
    return first != 0xFF && second != 0xFF;
}

static inline uint64_t opc4_get_word(const struct opc4_frame *frame)
{
    uint64_t word = 0;
    for (unsigned k = 8; k-- > 0;)
        word = word << 8 | frame->data[k];
    return word;
}

static inline void opc4_put_word(struct opc4_frame *frame, uint32_t id, uint64_t word)
{
    frame->time_ns = 0;
    frame->id = id;
    frame->length = 8;
    for (unsigned k = 0; k < 8; k++)
        frame->data[k] = (uint8_t)(word >> 8 * k);
}

/* --- end-to-end protection: AUTOSAR E2E profile 2, see can_dbc/e2e.py --- */

static inline uint8_t opc4_crc(const struct opc4_frame *frame, uint8_t data_id)
{
    uint32_t crc = 0xFF;
    for (unsigned k = 1; k <= 8; k++) {
        crc ^= k < 8 ? frame->data[k] : data_id;
        for (unsigned bit = 0; bit < 8; bit++)
            crc = (crc & 0x80u) != 0 ? (crc << 1 ^ 0x2Fu) & 0xFFu : crc << 1 & 0xFFu;
    }
    return (uint8_t)(crc ^ 0xFFu);
}

/* Write counter and checksum into a packed frame, and count on. */
static inline void opc4_protect(struct opc4_frame *frame, const uint8_t data_ids[16], uint8_t *counter)
{
    frame->data[1] = (uint8_t)(frame->data[1] | *counter);
    frame->data[0] = opc4_crc(frame, data_ids[*counter]);
    *counter = (uint8_t)((*counter + 1u) % 16u);
}

/* Whether the checksum belongs to the frame. */
static inline bool opc4_check(const struct opc4_frame *frame, const uint8_t data_ids[16])
{
    return frame->length == 8 && frame->data[0] == opc4_crc(frame, data_ids[frame->data[1] % 16u]);
}

enum opc4_e2e_state { OPC4_E2E_STATE_INIT, OPC4_E2E_STATE_VALID, OPC4_E2E_STATE_INVALID };
enum opc4_e2e_status {
    OPC4_E2E_OK, OPC4_E2E_OK_SOME_LOST, OPC4_E2E_REPEATED, OPC4_E2E_WRONG_SEQUENCE, OPC4_E2E_ERROR,
    OPC4_E2E_INITIAL, OPC4_E2E_SYNC
};

/* The receiving end of one channel; all zero but the timeout before its first frame. */
struct opc4_channel {
    int64_t timeout_ns; /* without a good frame for so long, the channel is invalid */
    int64_t alive_ns;
    enum opc4_e2e_state state;
    enum opc4_e2e_status window[3]; /* of the latest checks, the newest first */
    unsigned checks; /* in the window */
    bool has_begun;
    bool must_sync;
    unsigned last_counter, max_delta, repeated;
};

/* Whether the channel may be trusted now. */
static inline enum opc4_e2e_state opc4_state(struct opc4_channel *channel, int64_t now_ns)
{
    if (now_ns - channel->alive_ns > channel->timeout_ns) {
        channel->state = OPC4_E2E_STATE_INVALID;
        channel->checks = 0;
    }
    return channel->state;
}

static inline enum opc4_e2e_status opc4_check_counter(struct opc4_channel *channel, unsigned counter)
{
    const unsigned delta = (counter + 16u - channel->last_counter) % 16u;
    if (channel->has_begun && delta == 0) {
        channel->repeated += channel->repeated < 15u;
        return OPC4_E2E_REPEATED;
    }
    const bool is_first = !channel->has_begun, is_interrupted = channel->repeated > 3;
    const bool jumps = !is_first && delta > channel->max_delta, syncs = channel->must_sync;
    channel->last_counter = counter;
    channel->max_delta = 2;
    channel->has_begun = true;
    if (is_first)
        return OPC4_E2E_INITIAL;
    channel->repeated = 0;
    channel->must_sync = jumps || is_interrupted;
    if (jumps)
        return OPC4_E2E_WRONG_SEQUENCE;
    if (is_interrupted || syncs)
        return OPC4_E2E_SYNC;
    return delta == 1 ? OPC4_E2E_OK : OPC4_E2E_OK_SOME_LOST;
}

static inline void opc4_judge(struct opc4_channel *channel, enum opc4_e2e_status status)
{
    unsigned accepted = 0, errors = 0, good = 0;
    if (!channel->has_begun && channel->state == OPC4_E2E_STATE_INIT)
        return; /* nothing but errors yet */
    channel->window[2] = channel->window[1];
    channel->window[1] = channel->window[0];
    channel->window[0] = status;
    channel->checks += channel->checks < 3;
    for (unsigned k = 0; k < channel->checks; k++) {
        good += channel->window[k] == OPC4_E2E_OK;
        accepted += channel->window[k] <= OPC4_E2E_OK_SOME_LOST;
        errors += channel->window[k] == OPC4_E2E_ERROR;
    }
    if (channel->state == OPC4_E2E_STATE_VALID) {
        if (good != channel->checks && (accepted < 1 || errors > 1))
            channel->state = OPC4_E2E_STATE_INVALID;
    } else if (channel->state == OPC4_E2E_STATE_INIT) {
        if (errors > 1)
            channel->state = OPC4_E2E_STATE_INVALID;
        else if (accepted >= 1)
            channel->state = OPC4_E2E_STATE_VALID;
    } else if (accepted >= 2 && errors == 0) {
        channel->state = OPC4_E2E_STATE_VALID;
    }
}

/* Check a frame of the channel; `is_sound` is what its unpack returned. Return whether its content is
 * to be used, while opc4_state is VALID. */
static inline bool opc4_receive(struct opc4_channel *channel, const struct opc4_frame *frame,
                                const uint8_t data_ids[16], bool is_sound)
{
    enum opc4_e2e_status status = OPC4_E2E_ERROR;
    (void)opc4_state(channel, frame->time_ns);
    channel->max_delta += channel->max_delta < 15u;
    if (opc4_check(frame, data_ids) && is_sound)
        status = opc4_check_counter(channel, frame->data[1] % 16u);
    if (status <= OPC4_E2E_OK_SOME_LOST || status == OPC4_E2E_INITIAL)
        channel->alive_ns = frame->time_ns;
    opc4_judge(channel, status);
    return status <= OPC4_E2E_OK_SOME_LOST;
}

/* --- messages of opc4.dbc --- */

@MESSAGES@
#endif
