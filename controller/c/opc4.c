/* The OPC4 firmware in C99: bit for bit that of controller/firmware.py, which is read first.
 * Plain push, blow cut, air cushion, sliding mode, synchro brake. */
#include "opc4.h"

#define MAX_PULSES 23 /* of a step that are used: one period of 20 ms at 1 ms, and 3 */

static const struct opc4_settings *const settings = &fw_in.settings;

#include "position.h"
#include "shift.h"
#include "strategies.h"

enum { POSITION, REQUEST, SPEEDS, CHANNELS };

static struct {
    struct opc4_channel channels[CHANNELS];
    bool has_been_valid[CHANNELS];
    struct opc4_position_pulse pulses[MAX_PULSES];
    int pulse_count;
    struct opc4_shift_request request;
    struct opc4_driveline_speeds speeds;
    uint64_t speeds_word, noted_word; /* the frame of the latest speeds; that of the latest step */
    bool is_noted;
    int64_t noted_ns;
    bool has_begun;
    int64_t start_ns, sampled_ns, etc1_due_ns, etc2_due_ns;
    unsigned latched; /* faults */
    struct duties duties; /* of the latest step */
    bool has_been_filled[3];
    int64_t filled_ns[3]; /* by chamber */
} unit;

/* --- inputs --- */

static void keep_pulse(const struct opc4_position_pulse *pulse)
{
    if (unit.pulse_count == position.most_pulses) {
        for (int k = 1; k < unit.pulse_count; k++)
            unit.pulses[k - 1] = unit.pulses[k];
        unit.pulse_count--;
    }
    unit.pulses[unit.pulse_count++] = *pulse;
}

static void take(const struct opc4_frame *frame)
{
    struct opc4_position_pulse pulse;
    struct opc4_shift_request request = { OPC4_GEAR_UNKNOWN };
    struct opc4_driveline_speeds speeds;
    if (frame->id == OPC4_POSITION_PULSE_ID) {
        const bool is_sound = opc4_unpack_position_pulse(frame, &pulse);
        if (opc4_receive(&unit.channels[POSITION], frame, opc4_position_pulse_data_ids, is_sound))
            keep_pulse(&pulse);
    } else if (frame->id == OPC4_SHIFT_REQUEST_ID) {
        const bool is_sound = opc4_unpack_shift_request(frame, &request);
        if (opc4_receive(&unit.channels[REQUEST], frame, opc4_shift_request_data_ids, is_sound))
            unit.request = request;
    } else if (frame->id == OPC4_DRIVELINE_SPEEDS_ID) {
        const bool is_sound = opc4_unpack_driveline_speeds(frame, &speeds);
        if (opc4_receive(&unit.channels[SPEEDS], frame, opc4_driveline_speeds_data_ids, is_sound)) {
            unit.speeds = speeds;
            unit.speeds_word = opc4_get_word(frame);
        }
    }
}

/* Whether a channel is lost: no longer valid, or never valid when it should be by now. */
static bool is_lost(unsigned channel, enum opc4_e2e_state state, bool is_waking)
{
    if (state == OPC4_E2E_STATE_VALID) {
        unit.has_been_valid[channel] = true;
        return false;
    }
    return state == OPC4_E2E_STATE_INVALID || unit.has_been_valid[channel] || !is_waking;
}

/* Update the position; return its faults. */
static unsigned sense(int64_t now_ns, bool is_waking)
{
    const enum opc4_e2e_state state = opc4_state(&unit.channels[POSITION], now_ns);
    const bool is_valid = state == OPC4_E2E_STATE_VALID;
    bool lost = is_lost(POSITION, state, is_waking);
    if (!is_valid)
        unit.sampled_ns = now_ns;
    position_update(unit.pulses, unit.pulse_count, !is_valid);
    unit.pulse_count = 0;
    if (position.estimate.count > 0) {
        unit.sampled_ns = now_ns;
    } else if (now_ns - unit.sampled_ns > opc4_ns(settings->e2e.position_timeout_s)) {
        lost = true; /* valid, but no usable sample */
        position_update(unit.pulses, 0, true);
    }
    return (lost ? OPC4_FAULT_POSITION_LOST : 0u) | (position.implausible ? OPC4_FAULT_POSITION_IMPLAUSIBLE : 0u);
}

/* Return the faults of request and speeds; `requested`: the driver's request, UNKNOWN without a valid one. */
static unsigned judge_inputs(int64_t now_ns, bool is_waking, enum opc4_gear *requested)
{
    const enum opc4_e2e_state speeds_state = opc4_state(&unit.channels[SPEEDS], now_ns);
    const enum opc4_e2e_state request_state = opc4_state(&unit.channels[REQUEST], now_ns);
    unsigned faults = is_lost(SPEEDS, speeds_state, is_waking) ? OPC4_FAULT_SPEEDS_LOST : 0u;
    *requested = OPC4_GEAR_UNKNOWN;
    if (is_lost(REQUEST, request_state, is_waking))
        faults |= OPC4_FAULT_REQUEST_LOST;
    if (request_state == OPC4_E2E_STATE_VALID) {
        *requested = unit.request.target;
        if (*requested == OPC4_GEAR_UNKNOWN)
            faults |= OPC4_FAULT_REQUEST_INVALID;
    }
    return faults;
}

/* --- interlock of the two outer chambers --- */

/* Whether a chamber has been off for the interlock time; a command acts for its whole period. */
static bool is_clear(int64_t now_ns, enum opc4_chamber chamber)
{
    const int64_t apart_ns = opc4_ns(settings->shift.interlock_s) + opc4_ns(settings->period_s);
    return !unit.has_been_filled[chamber] || now_ns - unit.filled_ns[chamber] >= apart_ns;
}

static bool is_allowed(int64_t now_ns, const struct duties *duties)
{
    const bool fills_b = duties->of[OPC4_CHAMBER_B] > settings->duty_closed;
    const bool fills_f = duties->of[OPC4_CHAMBER_F] > settings->duty_closed;
    if (fills_b)
        return !fills_f && is_clear(now_ns, OPC4_CHAMBER_F);
    return !fills_f || is_clear(now_ns, OPC4_CHAMBER_B);
}

static void note_filled(int64_t now_ns, const struct duties *duties, enum opc4_chamber blown)
{
    for (unsigned chamber = 0; chamber < 3; chamber++) {
        if (duties->of[chamber] > settings->duty_closed || chamber == (unsigned)blown) {
            unit.has_been_filled[chamber] = true;
            unit.filled_ns[chamber] = now_ns;
        }
    }
}

/* --- one step --- */

static enum opc4_chamber blown_chamber(void)
{
    return machine.state == OPC4_SHIFT_STATE_BLOW ? chamber_of(machine.leg) : OPC4_CHAMBER_NONE;
}

static void run_machine(int64_t now_ns, enum opc4_gear requested, const struct opc4_driveline_speeds *speeds)
{
    struct observation seen = { .now_ns = now_ns, .requested = requested };
    windows_update();
    if (speeds != NULL) {
        const double apart_rad_s = absolute(speeds->input_rad_s - speeds->output_rad_s);
        seen.speeds = apart_rad_s <= settings->shift.sync_tolerance_rad_s ? SPEEDS_AGREE : SPEEDS_APART;
    }
    seen.position_valid = position.estimate.valid;
    seen.gear = position.is_stuck ? OPC4_GEAR_UNKNOWN : position.gear;
    seen.run = position.run;
    seen.moved = position_moved();
    seen.clear_b = is_clear(now_ns, OPC4_CHAMBER_F);
    seen.clear_f = is_clear(now_ns, OPC4_CHAMBER_B);
    seen.recoverable = (unit.latched & OPC4_FAULT_INTERNAL) == 0;
    shift_step(&seen);
    if (machine.event == LEG_STARTED)
        position_mark();
    if (machine.event == LEG_STARTED || machine.event == PAUSE_OVER)
        strategy_reset();
}

static void note_speeds(int64_t now_ns, bool has_speeds)
{
    if (has_speeds != unit.is_noted || (has_speeds && unit.speeds_word != unit.noted_word)) {
        unit.is_noted = has_speeds;
        unit.noted_word = unit.speeds_word;
        unit.noted_ns = now_ns;
    }
}

static struct duties drive(int64_t now_ns, bool has_speeds)
{
    struct duties duties = { { 0.0, 0.0, 0.0 } };
    if (is_in(DRIVING)) {
        const double towards = machine.leg == OPC4_GEAR_BACKWARD ? 1.0 : -1.0;
        struct push push = { .spent_ns = now_ns - machine.attempt_ns, .has_speeds = has_speeds };
        push.spent_s = (double)push.spent_ns * 1e-9;
        push.travelled_m = towards * position.estimate.last.position_m;
        push.speed_m_s = towards * position.estimate.last.velocity_m_s;
        push.apart_rad_s = absolute(unit.speeds.input_rad_s - unit.speeds.output_rad_s);
        push.apart_s = (double)(unit.noted_ns - machine.attempt_ns) * 1e-9;
        duties = strategy_command(machine.leg, machine.attempt, &push);
        if (!is_allowed(now_ns, &duties)) {
            const struct duties off = { { 0.0, 0.0, 0.0 } };
            shift_fail(OPC4_FAULT_INTERNAL);
            duties = off;
        }
    }
    const enum opc4_chamber blown = blown_chamber();
    if (machine.event == CONFIRMED) /* SafetyBlow arrives later: hold the coil until then */
        duties.of[blown] = unit.duties.of[blown];
    note_filled(now_ns, &duties, blown);
    return duties;
}

/* --- outputs --- */

static void send_etc1(int64_t now_ns, const struct opc4_driveline_speeds *speeds)
{
    struct opc4_etc1 etc1 = { .has_driveline_engaged = machine.confirmed != OPC4_GEAR_UNKNOWN };
    if (now_ns < unit.etc1_due_ns)
        return;
    unit.etc1_due_ns += 10000000;
    etc1.driveline_engaged = machine.confirmed != OPC4_GEAR_NEUTRAL;
    etc1.has_shift_in_process = true;
    etc1.shift_in_process = is_in_process();
    if (speeds != NULL) {
        double ratio = speeds->referred == OPC4_GEAR_BACKWARD  ? settings->broadcast.ratio_backward
                       : speeds->referred == OPC4_GEAR_FORWARD ? settings->broadcast.ratio_forward
                                                               : 0.0;
        if (!(ratio > 0.0))
            ratio = 1.0;
        etc1.output_shaft_rad_s = speeds->output_rad_s;
        etc1.has_output_shaft_rad_s = 0.0 <= etc1.output_shaft_rad_s && etc1.output_shaft_rad_s <= 841.0;
        etc1.input_shaft_rad_s = speeds->input_rad_s * ratio;
        etc1.has_input_shaft_rad_s = 0.0 <= etc1.input_shaft_rad_s && etc1.input_shaft_rad_s <= 841.0;
    }
    opc4_send_etc1(&etc1);
}

static void put_range(char range[2], enum opc4_gear gear)
{
    range[0] = ' ';
    range[1] = "NBF?"[gear];
}

static void send_etc2(int64_t now_ns)
{
    const enum opc4_gear current = machine.confirmed;
    const enum opc4_gear selected = is_in_process() ? machine.final : current;
    const int64_t numbers[4] = { 0, settings->broadcast.gear_backward, settings->broadcast.gear_forward, 0 };
    const double ratios[4] = { 0.0, settings->broadcast.ratio_backward, settings->broadcast.ratio_forward, 0.0 };
    struct opc4_etc2 etc2 = { .has_selected_gear = selected != OPC4_GEAR_UNKNOWN };
    if (now_ns < unit.etc2_due_ns)
        return;
    unit.etc2_due_ns += opc4_ns(settings->broadcast.etc2_period_s);
    etc2.selected_gear = (int32_t)numbers[selected];
    etc2.has_requested_range = etc2.has_selected_gear;
    put_range(etc2.requested_range, selected);
    etc2.has_current_gear = etc2.has_current_range = current != OPC4_GEAR_UNKNOWN;
    etc2.current_gear = (int32_t)numbers[current];
    put_range(etc2.current_range, current);
    etc2.gear_ratio = ratios[current];
    etc2.has_gear_ratio = etc2.gear_ratio > 0.0;
    opc4_send_etc2(&etc2);
}

static void report(int64_t now_ns, const struct opc4_driveline_speeds *speeds, unsigned faults)
{
    const struct opc4_valve_command valves = {
        unit.duties.of[OPC4_CHAMBER_B], unit.duties.of[OPC4_CHAMBER_N], unit.duties.of[OPC4_CHAMBER_F],
        is_in(DRIVING) ? machine.leg : machine.confirmed,
    };
    const struct opc4_controller_status status = {
        machine.state, machine.confirmed, position.estimate.last.position_m, (enum opc4_fault)faults,
    };
    struct opc4_safety_blow blow = { blown_chamber(), false, 0.0 };
    if (blow.chamber != OPC4_CHAMBER_NONE) {
        blow.active = true;
        blow.remaining_s = (double)(machine.until_ns - now_ns) / 1e9;
    }
    opc4_send_valve_command(&valves);
    opc4_send_safety_blow(&blow);
    opc4_send_controller_status(&status);
    send_etc1(now_ns, speeds);
    send_etc2(now_ns);
}

void fw_init(void)
{
    const int64_t strategy_index = settings->strategy;
    if (strategy_index == OPC4_STRATEGY_FIXED_PROGRAMME || strategy_index > OPC4_STRATEGY_SLIDING_MODE)
        opc4_fail("controller.strategy: not in the firmware in C; expected open_loop, blow_cut, air_cushion, "
                  "sliding_mode or synchro_brake");
    position_init();
    shift_init();
    unit.channels[POSITION].timeout_ns = opc4_ns(settings->e2e.position_timeout_s);
    unit.channels[REQUEST].timeout_ns = opc4_ns(settings->e2e.request_timeout_s);
    unit.channels[SPEEDS].timeout_ns = opc4_ns(settings->e2e.speeds_timeout_s);
}

void fw_step(void)
{
    const int64_t now_ns = fw_in.now_ns;
    enum opc4_gear requested;
    if (!unit.has_begun) {
        unit.has_begun = true;
        unit.start_ns = unit.sampled_ns = unit.etc1_due_ns = unit.etc2_due_ns = now_ns;
        for (unsigned channel = 0; channel < CHANNELS; channel++)
            unit.channels[channel].alive_ns = now_ns; /* the clock may have run before */
    }
    for (uint32_t k = 0; k < fw_in.count; k++)
        take(&fw_in.frames[k]);
    const bool is_waking = now_ns - unit.start_ns < opc4_ns(settings->e2e.startup_s);
    const unsigned position_faults = sense(now_ns, is_waking);
    unsigned faults = judge_inputs(now_ns, is_waking, &requested) | position_faults;
    const bool has_speeds = unit.channels[SPEEDS].state == OPC4_E2E_STATE_VALID;
    const struct opc4_driveline_speeds *speeds = has_speeds ? &unit.speeds : NULL;
    run_machine(now_ns, requested, speeds);
    note_speeds(now_ns, has_speeds);
    const struct duties duties = drive(now_ns, has_speeds);
    if (machine.raised == OPC4_FAULT_SENSOR_STUCK)
        position_distrust();
    if (machine.state == OPC4_SHIFT_STATE_FAULT && unit.latched == 0)
        unit.latched = machine.raised | position_faults;
    else if (machine.event == RECOVERED)
        unit.latched = OPC4_FAULT_NONE;
    if (position.is_stuck)
        faults |= OPC4_FAULT_SENSOR_STUCK;
    unit.duties = duties;
    report(now_ns, speeds, faults | unit.latched);
}
