/* Pulse duration to position: calibration, plausibility, filter, gear windows (controller/position.py). */

struct sample {
    double raw_m, position_m, velocity_m_s;
};

/* The newest sample, and those accepted in this step, oldest first. */
struct estimate {
    bool valid;
    struct sample last;
    unsigned count;
    struct sample samples[MAX_PULSES];
};

static struct {
    double range_m, reach_m, slack_m, leak_m, travel_top_m; /* limits of what the stay can do */
    double travel_m;
    int64_t level;
    bool implausible;

    double state[4][2]; /* of the filter's sections */
    double rate_hz, still_m;
    int most_pulses, longest_gap;
    bool is_settled, has_plausible, is_stuck;
    int index, plausible_index; /* of the last good sample; of the last one in range */
    double plausible_m, lowest_m, highest_m, stuck_at_m;
    struct estimate estimate;

    enum opc4_gear gear; /* whose window holds the position, and for how many samples in a row */
    int64_t run;
} position;

static double absolute(double value)
{
    return value < 0.0 ? -value : value;
}

static int modulo_256(int index)
{
    return (index % 256 + 256) % 256;
}

static void position_init(void)
{
    position.still_m = (double)settings->sensor.still_ticks * settings->sensor.timer_resolution_s
                       / settings->sensor.slope_s_per_m;
    position.range_m = settings->windows.stroke_m + settings->sensor.overtravel_m;
    position.reach_m = settings->sensor.max_speed_m_s * settings->sensor.period_s;
    position.slack_m = position.still_m;
    position.leak_m = settings->sensor.travel_leak_m_s * settings->sensor.period_s;
    position.travel_top_m = settings->sensor.travel_limit_m + settings->windows.stroke_m;
    position.rate_hz = 1.0 / settings->sensor.period_s;
    position.most_pulses = (int)(settings->period_s / settings->sensor.period_s) + 3;
    position.longest_gap = 64;
    if (settings->e2e.position_timeout_s / settings->sensor.period_s < 64.0)
        position.longest_gap = (int)(settings->e2e.position_timeout_s / settings->sensor.period_s);
    position.gear = OPC4_GEAR_UNKNOWN;
}

static void filter_settle(double value)
{
    for (int64_t k = 0; k < settings->section_count; k++) {
        const double *section = settings->sections[k];
        position.state[k][0] = (1.0 - section[0]) * value;
        position.state[k][1] = (section[2] - section[4]) * value;
    }
}

static double filter_update(double value)
{
    for (int64_t k = 0; k < settings->section_count; k++) {
        const double *section = settings->sections[k]; /* b0, b1, b2, a1, a2 */
        double *state = position.state[k];
        const double out = section[0] * value + state[0];
        state[0] = section[1] * value - section[3] * out + state[1];
        state[1] = section[2] * value - section[4] * out;
        value = out;
    }
    return value;
}

/* Whether the stay can move that far in so many sample periods; adds to the travel. */
static bool follows(double distance_m, int samples)
{
    const double way_m = absolute(distance_m);
    double travel_m = position.travel_m - position.leak_m * samples;
    travel_m = (travel_m > 0.0 ? travel_m : 0.0) + way_m;
    position.travel_m = travel_m < position.travel_top_m ? travel_m : position.travel_top_m;
    const double reach_m = position.reach_m * samples + position.slack_m;
    return way_m <= reach_m && travel_m <= settings->sensor.travel_limit_m;
}

static void judge_sample(bool good)
{
    if (good) {
        if (position.level > 0)
            position.level--;
        if (position.level == 0)
            position.implausible = false;
    } else {
        position.level += 2;
        if (position.level >= settings->sensor.bad_limit) {
            position.level = settings->sensor.bad_limit;
            position.implausible = true;
        }
    }
    if (position.implausible)
        position.is_settled = false;
}

static void settle_at(double raw_m)
{
    const struct sample rest = { raw_m, raw_m, 0.0 };
    if (settings->filter.enabled != 0)
        filter_settle(raw_m);
    position.is_settled = true;
    position.estimate.last = rest;
}

/* Filter up to a new sample; those that are missing in between are interpolated. */
static void filter_to(double raw_m, int steps)
{
    const double start_m = position.estimate.last.raw_m;
    double before_m = position.estimate.last.position_m;
    for (int step = 1; step <= steps; step++) {
        double position_m = start_m + (raw_m - start_m) * step / steps;
        if (settings->filter.enabled != 0)
            position_m = filter_update(position_m);
        position.estimate.last.velocity_m_s = (position_m - before_m) * position.rate_hz;
        position.estimate.last.position_m = before_m = position_m;
    }
    position.estimate.last.raw_m = raw_m;
}

static void accept(int index)
{
    struct estimate *estimate = &position.estimate;
    const double raw_m = estimate->last.raw_m;
    position.index = index;
    if (raw_m < position.lowest_m)
        position.lowest_m = raw_m;
    if (raw_m > position.highest_m)
        position.highest_m = raw_m;
    if (position.is_stuck && absolute(raw_m - position.stuck_at_m) > position.still_m)
        position.is_stuck = false;
    estimate->samples[estimate->count++] = estimate->last;
}

static void take_pulse(const struct opc4_position_pulse *pulse)
{
    const double coil_k = pulse->coil_temperature_k;
    const double warmth = 1.0 + settings->sensor.temp_coeff_per_k * (coil_k - settings->sensor.t_ref_k);
    const double raw_m = (pulse->pulse_s / warmth - settings->sensor.t_mid_s) / settings->sensor.slope_s_per_m;
    bool good = true;
    if (!(settings->sensor.temperature_min_k <= coil_k && coil_k <= settings->sensor.temperature_max_k
          && -position.range_m <= raw_m && raw_m <= position.range_m)) {
        judge_sample(false);
        return;
    }
    if (position.has_plausible) {
        const int steps = modulo_256(pulse->sample_index - position.plausible_index);
        if (steps == 0)
            return; /* a repeated sample holds no information */
        good = follows(raw_m - position.plausible_m, steps);
    }
    position.has_plausible = true;
    position.plausible_m = raw_m;
    position.plausible_index = pulse->sample_index;
    judge_sample(good);
    if (!good || position.implausible)
        return;
    const int gap = modulo_256(pulse->sample_index - position.index);
    if (!position.is_settled || gap > position.longest_gap)
        settle_at(raw_m);
    else
        filter_to(raw_m, gap);
    accept(pulse->sample_index);
}

/* Take the pulses of a step; `lost`: the channel is not valid, the estimate starts afresh later. */
static void position_update(const struct opc4_position_pulse *taken, int count, bool lost)
{
    position.estimate.count = 0;
    if (lost) {
        position.is_settled = position.has_plausible = false;
        position.travel_m = 0.0;
    } else {
        for (int k = 0; k < count; k++)
            take_pulse(&taken[k]);
    }
    position.estimate.valid = position.is_settled;
}

/* Whether the sensor has changed by more than its ticks since position_mark. */
static bool position_moved(void)
{
    return position.highest_m - position.lowest_m > position.still_m;
}

static void position_mark(void)
{
    position.lowest_m = position.highest_m = position.estimate.last.raw_m;
}

static void position_distrust(void)
{
    position.is_stuck = true;
    position.stuck_at_m = position.estimate.last.raw_m;
}

static enum opc4_gear gear_at(double position_m)
{
    const double engaged_m = settings->windows.stroke_m - settings->windows.gear_tolerance_m;
    if (position_m >= engaged_m)
        return OPC4_GEAR_BACKWARD;
    if (position_m <= -engaged_m)
        return OPC4_GEAR_FORWARD;
    if (absolute(position_m) <= settings->windows.neutral_tolerance_m)
        return OPC4_GEAR_NEUTRAL;
    return OPC4_GEAR_UNKNOWN;
}

/* A sample is in a window only if it is so both as measured and filtered: the filter overshoots. */
static void windows_update(void)
{
    if (!position.estimate.valid) {
        position.gear = OPC4_GEAR_UNKNOWN;
        position.run = 0;
        return;
    }
    for (unsigned k = 0; k < position.estimate.count; k++) {
        const struct sample *sample = &position.estimate.samples[k];
        enum opc4_gear gear = gear_at(sample->position_m);
        if (gear != gear_at(sample->raw_m))
            gear = OPC4_GEAR_UNKNOWN;
        position.run = gear == position.gear ? position.run + 1 : 1;
        position.gear = gear;
    }
}
