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

enum opc4_strategy { OPC4_STRATEGY_OPEN_LOOP = 0, OPC4_STRATEGY_BLOW_CUT = 1, OPC4_STRATEGY_AIR_CUSHION = 2, OPC4_STRATEGY_SYNCHRO_BRAKE = 3, OPC4_STRATEGY_FIXED_PROGRAMME = 4, OPC4_STRATEGY_SLIDING_MODE = 5, OPC4_STRATEGY_BANG_BANG = 6, OPC4_STRATEGY_PREDICTIVE = 7 };
enum opc4_cut { OPC4_CUT_NONE = 0, OPC4_CUT_SYNC = 1, OPC4_CUT_CONFIRMATION = 2 };

/* Times are in seconds: opc4_ns rounds them as the firmware in Python does. */
struct opc4_settings {
    double period_s; /* s */
    double computation_s; /* s */
    double ns_per_instruction; /* ns */
    double duty;
    double duty_closed;
    struct {
        double period_s; /* s */
        double t_mid_s; /* s */
        double slope_s_per_m; /* s/m */
        double temp_coeff_per_k; /* 1/K */
        double t_ref_k; /* K */
        double timer_resolution_s; /* s */
        double temperature_min_k; /* K */
        double temperature_max_k; /* K */
        double overtravel_m; /* m */
        double max_speed_m_s; /* m/s */
        double travel_limit_m; /* m */
        double travel_leak_m_s; /* m/s */
        int64_t bad_limit;
        int64_t still_ticks;
    } sensor;
    struct {
        int64_t enabled;
        int64_t order;
        double fc_hz; /* Hz */
    } filter;
    struct {
        double stroke_m; /* m */
        double neutral_tolerance_m; /* m */
        double gear_tolerance_m; /* m */
        int64_t samples;
    } windows;
    struct {
        double duration_s; /* s */
        int64_t cut;
    } blow;
    struct {
        double push_timeout_s; /* s */
        int64_t retries;
        double retry_pause_s; /* s */
        double no_motion_s; /* s */
        double reversal_settle_s; /* s */
        double hold_s; /* s */
        double vent_s; /* s */
        double interlock_s; /* s */
        double sync_tolerance_rad_s; /* rad/s */
        int64_t wait_for_sync;
        double sync_wait_s; /* s */
        double init_settle_s; /* s */
        double init_timeout_s; /* s */
    } shift;
    struct {
        double position_timeout_s; /* s */
        double request_timeout_s; /* s */
        double speeds_timeout_s; /* s */
        double startup_s; /* s */
    } e2e;
    struct {
        double etc2_period_s; /* s */
        int64_t gear_backward;
        int64_t gear_forward;
        double ratio_backward;
        double ratio_forward;
    } broadcast;
    int64_t strategy;
    struct {
        double neutral_s; /* s */
        double otherwise_s; /* s */
    } blow_cut;
    struct {
        double patience_s; /* s */
        double trigger_m; /* m */
        double lead_s; /* s */
        double burst_s; /* s */
        int64_t keep_charging;
    } air_cushion;
    struct {
        double patience_s; /* s */
        double brake_lead_s; /* s */
        double burst_s; /* s */
        double rest_lead_s; /* s */
        double rest_s; /* s */
        double least_lead_s; /* s */
        double least_rad_s; /* rad/s */
        double least_fall_rad_s2; /* rad/s2 */
    } synchro_brake;
    struct {
        double patience_s; /* s */
        double slope_per_s; /* 1/s */
        double band_m_s; /* m/s */
        double beyond_m; /* m */
    } sliding_mode;
    int64_t section_count;
    double sections[4][5]; /* b0, b1, b2, a1, a2 of each */
};
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
__attribute__((weak)) const uint32_t fw_contract = 984300564u;

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

enum opc4_gear { OPC4_GEAR_NEUTRAL = 0, OPC4_GEAR_BACKWARD = 1, OPC4_GEAR_FORWARD = 2, OPC4_GEAR_UNKNOWN = 3 };

enum opc4_chamber { OPC4_CHAMBER_B = 0, OPC4_CHAMBER_N = 1, OPC4_CHAMBER_F = 2, OPC4_CHAMBER_NONE = 3 };

enum opc4_shift_state { OPC4_SHIFT_STATE_INIT = 0, OPC4_SHIFT_STATE_IDLE = 1, OPC4_SHIFT_STATE_PUSH = 2, OPC4_SHIFT_STATE_CONFIRM = 3, OPC4_SHIFT_STATE_BLOW = 4, OPC4_SHIFT_STATE_HOLD = 5, OPC4_SHIFT_STATE_VENT = 6, OPC4_SHIFT_STATE_FAULT = 7 };

enum opc4_fault { OPC4_FAULT_NONE = 0, OPC4_FAULT_POSITION_LOST = 1, OPC4_FAULT_POSITION_IMPLAUSIBLE = 2, OPC4_FAULT_REQUEST_LOST = 4, OPC4_FAULT_SPEEDS_LOST = 8, OPC4_FAULT_SHIFT_TIMEOUT = 16, OPC4_FAULT_SENSOR_STUCK = 32, OPC4_FAULT_REQUEST_INVALID = 64, OPC4_FAULT_INTERNAL = 128 };

enum opc4_override_mode { OPC4_OVERRIDE_MODE_NONE = 0, OPC4_OVERRIDE_MODE_SPEED = 1, OPC4_OVERRIDE_MODE_TORQUE = 2, OPC4_OVERRIDE_MODE_LIMIT = 3 };

/* The driver's or vehicle's request for a gear; shift console to OPC4, every 20 ms. */
#define OPC4_SHIFT_REQUEST_ID 0x0CFF0005u
static const uint8_t opc4_shift_request_data_ids[16] = { 18, 65, 107, 36, 135, 87, 40, 41, 29, 254, 98, 100, 208, 157, 116, 17 };
struct opc4_shift_request {
    enum opc4_gear target; /* a Gear */
};

/* Return whether the frame is such a message; checksum and counter are not looked at. */
static inline bool opc4_unpack_shift_request(const struct opc4_frame *frame, struct opc4_shift_request *message)
{
    const uint64_t word = opc4_get_word(frame);
    if (frame->id != OPC4_SHIFT_REQUEST_ID || frame->length != 8 || (word & 0xFFFFFFFFFFFFC000u) != 0xFFFFFFFFFFFFC000u)
        return false;
    if (!opc4_is_within((int32_t)(word >> 12 & 0x3u), 0, 3))
        return false;
    message->target = (enum opc4_gear)(int32_t)(word >> 12 & 0x3u);
    return true;
}

/* Duty cycles 0..1 of the three solenoid valves and the gear they serve; OPC4, every tick. */
#define OPC4_VALVE_COMMAND_ID 0x08FF1003u
static const uint8_t opc4_valve_command_data_ids[16] = { 213, 237, 127, 47, 102, 158, 38, 232, 71, 74, 220, 12, 241, 159, 240, 25 };
struct opc4_valve_command {
    double duty_b; /* 0 to 1 */
    double duty_n; /* 0 to 1 */
    double duty_f; /* 0 to 1 */
    enum opc4_gear target; /* a Gear */
};

/* Return NULL, or which field cannot be sent. */
static inline const char *opc4_pack_valve_command(const struct opc4_valve_command *message, struct opc4_frame *frame)
{
    uint64_t word = 0x000000000000C000u;
    if (!opc4_put_number(&word, message->duty_b, 100.0, 1.0, 0.0, 0.0078125, 0.0, 12800.0, 0xFFFFu, 16))
        return "ValveCommand.duty_b cannot be sent; expected 0 to 1";
    if (!opc4_put_number(&word, message->duty_n, 100.0, 1.0, 0.0, 0.0078125, 0.0, 12800.0, 0xFFFFu, 32))
        return "ValveCommand.duty_n cannot be sent; expected 0 to 1";
    if (!opc4_put_number(&word, message->duty_f, 100.0, 1.0, 0.0, 0.0078125, 0.0, 12800.0, 0xFFFFu, 48))
        return "ValveCommand.duty_f cannot be sent; expected 0 to 1";
    if (!opc4_put_whole(&word, (int32_t)message->target, 0, 3, 0, 12))
        return "ValveCommand.target cannot be sent; expected a Gear";
    opc4_put_word(frame, OPC4_VALVE_COMMAND_ID, word);
    return NULL;
}

static inline void opc4_send_valve_command_at(const struct opc4_valve_command *message, const char *file, uint32_t line)
{
    static uint8_t counter;
    struct opc4_frame frame;
    const char *refused = opc4_pack_valve_command(message, &frame);
    if (refused != NULL) {
        opc4_fail_at(refused, file, line);
        return;
    }
    opc4_protect(&frame, opc4_valve_command_data_ids, &counter);
    opc4_send_at(&frame, file, line);
}
#define opc4_send_valve_command(message) opc4_send_valve_command_at((message), __FILE__, __LINE__)

/* The blow into a chamber after confirmation, and how long it still lasts; OPC4, every tick. */
#define OPC4_SAFETY_BLOW_ID 0x08FF1103u
static const uint8_t opc4_safety_blow_data_ids[16] = { 79, 186, 140, 92, 77, 54, 162, 244, 165, 35, 91, 57, 72, 234, 212, 6 };
struct opc4_safety_blow {
    enum opc4_chamber chamber; /* a Chamber */
    bool active; /* a bool */
    double remaining_s; /* s, 0 to 4.09594 */
};

/* Return NULL, or which field cannot be sent. */
static inline const char *opc4_pack_safety_blow(const struct opc4_safety_blow *message, struct opc4_frame *frame)
{
    uint64_t word = 0xFFFFFFFF00000000u;
    if (!opc4_put_whole(&word, (int32_t)message->chamber, 0, 3, 0, 12))
        return "SafetyBlow.chamber cannot be sent; expected a Chamber";
    if (!opc4_put_whole(&word, (int32_t)message->active, 0, 1, 0, 14))
        return "SafetyBlow.active cannot be sent; expected a bool";
    if (!opc4_put_number(&word, message->remaining_s, 1000.0, 1.0, 0.0, 0.0625, 0.0, 65535.0, 0xFFFFu, 16))
        return "SafetyBlow.remaining_s cannot be sent; expected 0 to 4.09594";
    opc4_put_word(frame, OPC4_SAFETY_BLOW_ID, word);
    return NULL;
}

static inline void opc4_send_safety_blow_at(const struct opc4_safety_blow *message, const char *file, uint32_t line)
{
    static uint8_t counter;
    struct opc4_frame frame;
    const char *refused = opc4_pack_safety_blow(message, &frame);
    if (refused != NULL) {
        opc4_fail_at(refused, file, line);
        return;
    }
    opc4_protect(&frame, opc4_safety_blow_data_ids, &counter);
    opc4_send_at(&frame, file, line);
}
#define opc4_send_safety_blow(message) opc4_send_safety_blow_at((message), __FILE__, __LINE__)

/* One measurement of the inductive sensor: time to 8 V, coil temperature, number mod 256. */
#define OPC4_POSITION_PULSE_ID 0x0CFF2091u
static const uint8_t opc4_position_pulse_data_ids[16] = { 152, 90, 96, 156, 117, 121, 182, 154, 253, 129, 131, 231, 60, 155, 120, 63 };
struct opc4_position_pulse {
    double pulse_s; /* s, 0 to 0.00409594 */
    double coil_temperature_k; /* K, 0 to 1000 */
    int32_t sample_index; /* a whole number from 0 to 255 */
};

/* Return whether the frame is such a message; checksum and counter are not looked at. */
static inline bool opc4_unpack_position_pulse(const struct opc4_frame *frame, struct opc4_position_pulse *message)
{
    const uint64_t word = opc4_get_word(frame);
    if (frame->id != OPC4_POSITION_PULSE_ID || frame->length != 8 || (word & 0xFF0000000000F000u) != 0xFF0000000000F000u)
        return false;
    if (!opc4_is_within((int32_t)(word >> 16 & 0xFFFFu), 0, 65535))
        return false;
    message->pulse_s = ((int32_t)(word >> 16 & 0xFFFFu) * 0.0625 + 0.0) * 1.0 / 1000000.0;
    if (!opc4_is_within((int32_t)(word >> 32 & 0xFFFFu), 0, 32000))
        return false;
    message->coil_temperature_k = ((int32_t)(word >> 32 & 0xFFFFu) * 0.03125 + 0.0) * 1.0 / 1.0;
    if (!opc4_is_within((int32_t)(word >> 48 & 0xFFu), 0, 255))
        return false;
    message->sample_index = (int32_t)(word >> 48 & 0xFFu) + 0;
    return true;
}

/* Shaft speeds referred to the synchronizer: equal means synchronized; every 10 ms. referred: the gear with whose ratio the input speed is referred; UNKNOWN if not stated. */
#define OPC4_DRIVELINE_SPEEDS_ID 0x0CFF2192u
static const uint8_t opc4_driveline_speeds_data_ids[16] = { 141, 31, 118, 10, 8, 48, 124, 16, 130, 62, 227, 169, 128, 199, 68, 73 };
struct opc4_driveline_speeds {
    double input_rad_s; /* rad/s, -1000 to 1000 */
    double output_rad_s; /* rad/s, -1000 to 1000 */
    enum opc4_gear referred; /* a Gear */
};

/* Return whether the frame is such a message; checksum and counter are not looked at. */
static inline bool opc4_unpack_driveline_speeds(const struct opc4_frame *frame, struct opc4_driveline_speeds *message)
{
    const uint64_t word = opc4_get_word(frame);
    if (frame->id != OPC4_DRIVELINE_SPEEDS_ID || frame->length != 8 || (word & 0x000000000000C000u) != 0x000000000000C000u)
        return false;
    if (!opc4_is_within(opc4_signed((int32_t)(word >> 16 & 0xFFFFFFu), 0xFFFFFF), -1024000, 1024000))
        return false;
    message->input_rad_s = (opc4_signed((int32_t)(word >> 16 & 0xFFFFFFu), 0xFFFFFF) * 0.0009765625 + 0.0) * 1.0 / 1.0;
    if (!opc4_is_within(opc4_signed((int32_t)(word >> 40 & 0xFFFFFFu), 0xFFFFFF), -1024000, 1024000))
        return false;
    message->output_rad_s = (opc4_signed((int32_t)(word >> 40 & 0xFFFFFFu), 0xFFFFFF) * 0.0009765625 + 0.0) * 1.0 / 1.0;
    if (!opc4_is_within((int32_t)(word >> 12 & 0x3u), 0, 3))
        return false;
    message->referred = (enum opc4_gear)(int32_t)(word >> 12 & 0x3u);
    return true;
}

/* The firmware's state, confirmed gear, position estimate and faults; OPC4, every tick. */
#define OPC4_CONTROLLER_STATUS_ID 0x10FF3003u
static const uint8_t opc4_controller_status_data_ids[16] = { 148, 210, 192, 109, 30, 183, 1, 225, 33, 49, 226, 114, 138, 82, 250, 222 };
struct opc4_controller_status {
    enum opc4_shift_state state; /* a ShiftState */
    enum opc4_gear confirmed; /* a Gear */
    double estimate_m; /* m, -0.5 to 0.5 */
    enum opc4_fault faults; /* a Fault */
};

/* Return NULL, or which field cannot be sent. */
static inline const char *opc4_pack_controller_status(const struct opc4_controller_status *message, struct opc4_frame *frame)
{
    uint64_t word = 0xFF00000000FC0000u;
    if (!opc4_put_whole(&word, (int32_t)message->state, 0, 7, 0, 12))
        return "ControllerStatus.state cannot be sent; expected a ShiftState";
    if (!opc4_put_whole(&word, (int32_t)message->confirmed, 0, 3, 0, 16))
        return "ControllerStatus.confirmed cannot be sent; expected a Gear";
    if (!opc4_put_number(&word, message->estimate_m, 1000000.0, 1.0, 0.0, 0.0625, -8000000.0, 8000000.0, 0xFFFFFFu, 32))
        return "ControllerStatus.estimate_m cannot be sent; expected -0.5 to 0.5";
    if (!opc4_put_whole(&word, (int32_t)message->faults, 0, 255, 0, 24))
        return "ControllerStatus.faults cannot be sent; expected a Fault";
    opc4_put_word(frame, OPC4_CONTROLLER_STATUS_ID, word);
    return NULL;
}

static inline void opc4_send_controller_status_at(const struct opc4_controller_status *message, const char *file, uint32_t line)
{
    static uint8_t counter;
    struct opc4_frame frame;
    const char *refused = opc4_pack_controller_status(message, &frame);
    if (refused != NULL) {
        opc4_fail_at(refused, file, line);
        return;
    }
    opc4_protect(&frame, opc4_controller_status_data_ids, &counter);
    opc4_send_at(&frame, file, line);
}
#define opc4_send_controller_status(message) opc4_send_controller_status_at((message), __FILE__, __LINE__)

/* J1939 Electronic Transmission Controller 1 (PGN 61442), source address 3, every 10 ms. None: the sender has no valid value (sent as not available; received as that or as error). SPN: driveline engaged 560, lockup 573, shift in process 574, lockup transition 4816, output shaft speed 191, clutch slip (0..1) 522, momentary overspeed 606, progressive shift disabled 607, momentary maximum power 5015, input shaft speed 161, controlling address 1482. */
#define OPC4_ETC1_ID 0x0CF00203u
struct opc4_etc1 {
    bool has_driveline_engaged;
    bool driveline_engaged; /* a bool or None */
    bool has_torque_converter_lockup;
    bool torque_converter_lockup; /* a bool or None */
    bool has_shift_in_process;
    bool shift_in_process; /* a bool or None */
    bool has_lockup_transition;
    bool lockup_transition; /* a bool or None */
    bool has_output_shaft_rad_s;
    double output_shaft_rad_s; /* rad/s, 0 to 841.096 or None */
    bool has_clutch_slip;
    double clutch_slip; /* 0 to 1 or None */
    bool has_momentary_overspeed;
    bool momentary_overspeed; /* a bool or None */
    bool has_progressive_shift_disabled;
    bool progressive_shift_disabled; /* a bool or None */
    bool has_momentary_maximum_power;
    bool momentary_maximum_power; /* a bool or None */
    bool has_input_shaft_rad_s;
    double input_shaft_rad_s; /* rad/s, 0 to 841.096 or None */
    bool has_controlling_address;
    int32_t controlling_address; /* a whole number from 0 to 253 or None */
};

/* Return NULL, or which field cannot be sent. */
static inline const char *opc4_pack_etc1(const struct opc4_etc1 *message, struct opc4_frame *frame)
{
    uint64_t word = 0x000000C000000000u;
    if (!message->has_driveline_engaged) {
        word |= (uint64_t)0x3u << 0;
    } else {
        if (!opc4_put_whole(&word, (int32_t)message->driveline_engaged, 0, 1, 0, 0))
            return "Etc1.driveline_engaged cannot be sent; expected a bool or None";
    }
    if (!message->has_torque_converter_lockup) {
        word |= (uint64_t)0x3u << 2;
    } else {
        if (!opc4_put_whole(&word, (int32_t)message->torque_converter_lockup, 0, 1, 0, 2))
            return "Etc1.torque_converter_lockup cannot be sent; expected a bool or None";
    }
    if (!message->has_shift_in_process) {
        word |= (uint64_t)0x3u << 4;
    } else {
        if (!opc4_put_whole(&word, (int32_t)message->shift_in_process, 0, 1, 0, 4))
            return "Etc1.shift_in_process cannot be sent; expected a bool or None";
    }
    if (!message->has_lockup_transition) {
        word |= (uint64_t)0x3u << 6;
    } else {
        if (!opc4_put_whole(&word, (int32_t)message->lockup_transition, 0, 1, 0, 6))
            return "Etc1.lockup_transition cannot be sent; expected a bool or None";
    }
    if (!message->has_output_shaft_rad_s) {
        word |= (uint64_t)0xFFFFu << 8;
    } else {
        if (!opc4_put_number(&word, message->output_shaft_rad_s, 30.0, 3.141592653589793, 0.0, 0.125, 0.0, 64255.0, 0xFFFFu, 8))
            return "Etc1.output_shaft_rad_s cannot be sent; expected 0 to 841.096 or None";
    }
    if (!message->has_clutch_slip) {
        word |= (uint64_t)0xFFu << 24;
    } else {
        if (!opc4_put_number(&word, message->clutch_slip, 100.0, 1.0, 0.0, 0.4, 0.0, 250.0, 0xFFu, 24))
            return "Etc1.clutch_slip cannot be sent; expected 0 to 1 or None";
    }
    if (!message->has_momentary_overspeed) {
        word |= (uint64_t)0x3u << 32;
    } else {
        if (!opc4_put_whole(&word, (int32_t)message->momentary_overspeed, 0, 1, 0, 32))
            return "Etc1.momentary_overspeed cannot be sent; expected a bool or None";
    }
    if (!message->has_progressive_shift_disabled) {
        word |= (uint64_t)0x3u << 34;
    } else {
        if (!opc4_put_whole(&word, (int32_t)message->progressive_shift_disabled, 0, 1, 0, 34))
            return "Etc1.progressive_shift_disabled cannot be sent; expected a bool or None";
    }
    if (!message->has_momentary_maximum_power) {
        word |= (uint64_t)0x3u << 36;
    } else {
        if (!opc4_put_whole(&word, (int32_t)message->momentary_maximum_power, 0, 1, 0, 36))
            return "Etc1.momentary_maximum_power cannot be sent; expected a bool or None";
    }
    if (!message->has_input_shaft_rad_s) {
        word |= (uint64_t)0xFFFFu << 40;
    } else {
        if (!opc4_put_number(&word, message->input_shaft_rad_s, 30.0, 3.141592653589793, 0.0, 0.125, 0.0, 64255.0, 0xFFFFu, 40))
            return "Etc1.input_shaft_rad_s cannot be sent; expected 0 to 841.096 or None";
    }
    if (!message->has_controlling_address) {
        word |= (uint64_t)0xFFu << 56;
    } else {
        if (!opc4_put_whole(&word, (int32_t)message->controlling_address, 0, 253, 0, 56))
            return "Etc1.controlling_address cannot be sent; expected a whole number from 0 to 253 or None";
    }
    opc4_put_word(frame, OPC4_ETC1_ID, word);
    return NULL;
}

static inline void opc4_send_etc1_at(const struct opc4_etc1 *message, const char *file, uint32_t line)
{
    struct opc4_frame frame;
    const char *refused = opc4_pack_etc1(message, &frame);
    if (refused != NULL) {
        opc4_fail_at(refused, file, line);
        return;
    }
    opc4_send_at(&frame, file, line);
}
#define opc4_send_etc1(message) opc4_send_etc1_at((message), __FILE__, __LINE__)

/* J1939 Electronic Transmission Controller 2 (PGN 61445), source address 3, every 10 ms. Gears: negative reverse, 0 neutral, positive forward, `GEAR_PARK` park. Ranges: the two characters as shown to the driver, the second one used first (" N"). None: no valid value. SPN: selected gear 524, actual ratio 526, current gear 523, requested range 162, current 163. */
#define OPC4_ETC2_ID 0x18F00503u
struct opc4_etc2 {
    bool has_selected_gear;
    int32_t selected_gear; /* a whole number from -125 to 126 or None */
    bool has_gear_ratio;
    double gear_ratio; /* 0 to 64.255 or None */
    bool has_current_gear;
    int32_t current_gear; /* a whole number from -125 to 126 or None */
    bool has_requested_range;
    char requested_range[2]; /* two characters of codes 0 to 254 or None */
    bool has_current_range;
    char current_range[2]; /* two characters of codes 0 to 254 or None */
};

/* Return NULL, or which field cannot be sent. */
static inline const char *opc4_pack_etc2(const struct opc4_etc2 *message, struct opc4_frame *frame)
{
    uint64_t word = 0x0000000000000000u;
    if (!message->has_selected_gear) {
        word |= (uint64_t)0xFFu << 0;
    } else {
        if (!opc4_put_whole(&word, (int32_t)message->selected_gear, -125, 126, -125, 0))
            return "Etc2.selected_gear cannot be sent; expected a whole number from -125 to 126 or None";
    }
    if (!message->has_gear_ratio) {
        word |= (uint64_t)0xFFFFu << 8;
    } else {
        if (!opc4_put_number(&word, message->gear_ratio, 1.0, 1.0, 0.0, 0.001, 0.0, 64255.0, 0xFFFFu, 8))
            return "Etc2.gear_ratio cannot be sent; expected 0 to 64.255 or None";
    }
    if (!message->has_current_gear) {
        word |= (uint64_t)0xFFu << 24;
    } else {
        if (!opc4_put_whole(&word, (int32_t)message->current_gear, -125, 126, -125, 24))
            return "Etc2.current_gear cannot be sent; expected a whole number from -125 to 126 or None";
    }
    if (!message->has_requested_range) {
        word |= (uint64_t)0xFFFFu << 32;
    } else {
        if (!opc4_put_text(&word, message->requested_range, 32))
            return "Etc2.requested_range cannot be sent; expected two characters of codes 0 to 254 or None";
    }
    if (!message->has_current_range) {
        word |= (uint64_t)0xFFFFu << 48;
    } else {
        if (!opc4_put_text(&word, message->current_range, 48))
            return "Etc2.current_range cannot be sent; expected two characters of codes 0 to 254 or None";
    }
    opc4_put_word(frame, OPC4_ETC2_ID, word);
    return NULL;
}

static inline void opc4_send_etc2_at(const struct opc4_etc2 *message, const char *file, uint32_t line)
{
    struct opc4_frame frame;
    const char *refused = opc4_pack_etc2(message, &frame);
    if (refused != NULL) {
        opc4_fail_at(refused, file, line);
        return;
    }
    opc4_send_at(&frame, file, line);
}
#define opc4_send_etc2(message) opc4_send_etc2_at((message), __FILE__, __LINE__)

/* J1939 Torque/Speed Control 1 (PGN 0), from the transmission to the engine, every 10 ms. SPN: override mode 695, requested speed 898, requested torque (of the reference torque) 518. */
#define OPC4_TSC1_ID 0x0C000003u
struct opc4_tsc1 {
    enum opc4_override_mode mode; /* a OverrideMode */
    bool has_speed_rad_s;
    double speed_rad_s; /* rad/s, 0 to 841.096 or None */
    bool has_torque;
    double torque; /* -1.25 to 1.25 or None */
};

/* Return NULL, or which field cannot be sent. */
static inline const char *opc4_pack_tsc1(const struct opc4_tsc1 *message, struct opc4_frame *frame)
{
    uint64_t word = 0xFFFFFFFF000000FCu;
    if (!opc4_put_whole(&word, (int32_t)message->mode, 0, 3, 0, 0))
        return "Tsc1.mode cannot be sent; expected a OverrideMode";
    if (!message->has_speed_rad_s) {
        word |= (uint64_t)0xFFFFu << 8;
    } else {
        if (!opc4_put_number(&word, message->speed_rad_s, 30.0, 3.141592653589793, 0.0, 0.125, 0.0, 64255.0, 0xFFFFu, 8))
            return "Tsc1.speed_rad_s cannot be sent; expected 0 to 841.096 or None";
    }
    if (!message->has_torque) {
        word |= (uint64_t)0xFFu << 24;
    } else {
        if (!opc4_put_number(&word, message->torque, 100.0, 1.0, -125.0, 1.0, 0.0, 250.0, 0xFFu, 24))
            return "Tsc1.torque cannot be sent; expected -1.25 to 1.25 or None";
    }
    opc4_put_word(frame, OPC4_TSC1_ID, word);
    return NULL;
}

static inline void opc4_send_tsc1_at(const struct opc4_tsc1 *message, const char *file, uint32_t line)
{
    struct opc4_frame frame;
    const char *refused = opc4_pack_tsc1(message, &frame);
    if (refused != NULL) {
        opc4_fail_at(refused, file, line);
        return;
    }
    opc4_send_at(&frame, file, line);
}
#define opc4_send_tsc1(message) opc4_send_tsc1_at((message), __FILE__, __LINE__)

/* J1939 Transmission Control 1 (PGN 256), shift console, every 50 ms; requested gear (SPN 525) as in `Etc2`. */
#define OPC4_TC1_ID 0x0C010305u
struct opc4_tc1 {
    bool has_requested_gear;
    int32_t requested_gear; /* a whole number from -125 to 126 or None */
};

/* Return whether the frame is such a message; checksum and counter are not looked at. */
static inline bool opc4_unpack_tc1(const struct opc4_frame *frame, struct opc4_tc1 *message)
{
    const uint64_t word = opc4_get_word(frame);
    if (frame->id != OPC4_TC1_ID || frame->length != 8)
        return false;
    message->has_requested_gear = (int32_t)(word >> 16 & 0xFFu) < 254;
    if (message->has_requested_gear && !opc4_is_within((int32_t)(word >> 16 & 0xFFu), 0, 251))
        return false;
    message->requested_gear = (int32_t)(word >> 16 & 0xFFu) - 125;
    return true;
}
#endif
