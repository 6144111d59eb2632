/* How a push is carried out (controller/strategies): which valves are filled for the coming period. */

struct duties {
    double of[3]; /* by chamber */
};

/* The push under way: late measurements from neutral towards the gear; times since it began. */
struct push {
    int64_t spent_ns;
    double spent_s, travelled_m, speed_m_s;
    bool has_speeds;
    double apart_rad_s, apart_s; /* distance of the shafts' speeds; when its report came */
};

struct command {
    bool charge, brake;
};

static struct {
    bool has_begun, has_release, brakes, rests;
    double begun_s, release_s, brake_s, rest_s;
    unsigned reports;
    double time_s[3], apart_rad_s[3]; /* of the latest reports, oldest first */
} strategy;

static void strategy_reset(void)
{
    strategy.has_begun = strategy.has_release = strategy.brakes = strategy.rests = false;
    strategy.reports = 0;
}

/* Whether something that began at a step goes on at this one. */
static bool is_within(double begun_s, double now_s, double length_s)
{
    return now_s - begun_s < length_s - 0.5e-9;
}

/* Fill the neutral chamber for a moment just before the end. */
static struct command air_cushion(const struct push *push)
{
    const double ahead_m = push->travelled_m + settings->air_cushion.lead_s * push->speed_m_s;
    if (!strategy.has_begun && ahead_m >= settings->air_cushion.trigger_m) {
        strategy.has_begun = true;
        strategy.begun_s = push->spent_s;
    }
    const bool burst = strategy.has_begun
                       && is_within(strategy.begun_s, push->spent_s, settings->air_cushion.burst_s);
    const struct command command = { settings->air_cushion.keep_charging != 0 || !burst, burst };
    return command;
}

/* Fill when above the band of s = slope (goal - x) - v, brake when below. */
static struct command sliding_mode(const struct push *push)
{
    const double goal_m = settings->windows.stroke_m + settings->sliding_mode.beyond_m;
    const double side_m_s = settings->sliding_mode.slope_per_s * (goal_m - push->travelled_m) - push->speed_m_s;
    const double band_m_s = settings->sliding_mode.band_m_s;
    const struct command command = { side_m_s > band_m_s, side_m_s < -band_m_s };
    return command;
}

/* Forecast when the parabola through three reports is zero, unless it falls too little. */
static void forecast(void)
{
    const double *t = strategy.time_s, *d = strategy.apart_rad_s;
    strategy.has_release = false;
    if (d[1] - d[2] < settings->synchro_brake.least_rad_s)
        return;
    const double first = (d[0] - d[1]) / (t[1] - t[0]), second = (d[1] - d[2]) / (t[2] - t[1]);
    double growth = 2.0 * (second - first) / (t[2] - t[0]);
    if (growth < 0.0)
        growth = 0.0;
    const double fall = second + 0.5 * growth * (t[2] - t[1]);
    const double last = __builtin_sqrt(fall * fall + 2.0 * growth * d[2]); /* with -fno-math-errno an instruction, no libm */
    const double least = settings->synchro_brake.least_fall_rad_s2;
    if (last < least || fall < 0.5 * least)
        return;
    strategy.has_release = true;
    strategy.release_s = t[2] + 2.0 * d[2] / (fall + last);
}

/* Take a new report of the shaft speeds. */
static void note_report(const struct push *push)
{
    if (!push->has_speeds) {
        strategy.reports = 0;
        strategy.has_release = false;
        return;
    }
    if (strategy.reports > 0 && push->apart_s <= strategy.time_s[strategy.reports - 1])
        return;
    if (strategy.reports == 3) {
        for (unsigned k = 0; k < 2; k++) {
            strategy.time_s[k] = strategy.time_s[k + 1];
            strategy.apart_rad_s[k] = strategy.apart_rad_s[k + 1];
        }
        strategy.reports = 2;
    }
    strategy.time_s[strategy.reports] = push->apart_s;
    strategy.apart_rad_s[strategy.reports] = push->apart_rad_s;
    strategy.reports++;
    if (strategy.reports == 3)
        forecast();
}

/* Brake so that the counter-pressure is there when the shafts run together. */
static struct command synchro_brake(const struct push *push)
{
    const struct command charge = { true, false };
    const double now_s = push->spent_s + 0.5 * settings->period_s; /* the step nearest to an instant */
    if (!strategy.brakes && !strategy.rests) {
        note_report(push);
        if (!strategy.has_release || strategy.release_s - now_s < settings->synchro_brake.least_lead_s)
            return charge;
    }
    if (!strategy.brakes && now_s >= strategy.release_s - settings->synchro_brake.brake_lead_s) {
        strategy.brakes = true;
        strategy.brake_s = now_s;
    }
    if (!strategy.rests && now_s >= strategy.release_s - settings->synchro_brake.rest_lead_s) {
        strategy.rests = true;
        strategy.rest_s = now_s;
    }
    const bool brake = strategy.brakes && is_within(strategy.brake_s, now_s, settings->synchro_brake.burst_s);
    const bool rest = strategy.rests && is_within(strategy.rest_s, now_s, settings->synchro_brake.rest_s);
    const struct command command = { !rest, brake };
    return command;
}

/* The chamber whose filling leads to a gear. */
static enum opc4_chamber chamber_of(enum opc4_gear gear)
{
    static const enum opc4_chamber chambers[4] = { OPC4_CHAMBER_N, OPC4_CHAMBER_B, OPC4_CHAMBER_F,
                                                   OPC4_CHAMBER_NONE };
    return chambers[gear];
}

static double patience_s(void)
{
    switch (settings->strategy) {
    case OPC4_STRATEGY_AIR_CUSHION: return settings->air_cushion.patience_s;
    case OPC4_STRATEGY_SLIDING_MODE: return settings->sliding_mode.patience_s;
    case OPC4_STRATEGY_SYNCHRO_BRAKE: return settings->synchro_brake.patience_s;
    default: return 0.0; /* never brakes */
    }
}

/* The duties of a push; braking strategies brake on the first way into a gear, while they have patience. */
static struct duties strategy_command(enum opc4_gear leg, int64_t attempt, const struct push *push)
{
    struct duties duties = { { 0.0, 0.0, 0.0 } };
    struct command command = { true, false };
    if (leg != OPC4_GEAR_NEUTRAL && attempt == 0 && push->spent_ns < opc4_ns(patience_s())) {
        if (settings->strategy == OPC4_STRATEGY_AIR_CUSHION)
            command = air_cushion(push);
        else if (settings->strategy == OPC4_STRATEGY_SLIDING_MODE)
            command = sliding_mode(push);
        else
            command = synchro_brake(push);
    }
    if (command.charge)
        duties.of[chamber_of(leg)] = settings->duty;
    if (command.brake)
        duties.of[OPC4_CHAMBER_N] = settings->duty;
    return duties;
}
