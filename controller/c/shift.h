/* The shift state machine: request, push, confirm, safety blow, hold, vent, faults (controller/shift.py). */

enum event {
    NO_EVENT, GEAR_FOUND, INIT_TIMEOUT, LEG_STARTED, LEG_WAITS, WINDOW_ENTERED, WINDOW_LEFT, CONFIRMED,
    SLIPPED, SHIFT_DONE, WAIT_CANCELLED, HOLD_OVER, VENT_OVER, RETRY, PAUSE_OVER, FAILED, POSITION_LOST,
    RECOVERED, EVENT_COUNT
};

/* States as bits, in the order of the contract. */
enum {
    INIT = 1, IDLE = 2, PUSH = 4, CONFIRM = 8, BLOW = 16, HOLD = 32, VENT = 64, FAULT = 128,
    DRIVING = PUSH | CONFIRM,
    UNDER_WAY = DRIVING | BLOW | HOLD | VENT
};

/* The next state by event, and the states that it may be taken in. */
static const struct {
    unsigned from;
    enum opc4_shift_state to[2]; /* of INIT and IDLE where position is lost, else the same */
} transitions[EVENT_COUNT] = {
    [GEAR_FOUND] = { INIT, { OPC4_SHIFT_STATE_IDLE, OPC4_SHIFT_STATE_IDLE } },
    [INIT_TIMEOUT] = { INIT, { OPC4_SHIFT_STATE_IDLE, OPC4_SHIFT_STATE_IDLE } },
    [LEG_STARTED] = { IDLE | UNDER_WAY, { OPC4_SHIFT_STATE_PUSH, OPC4_SHIFT_STATE_PUSH } },
    [LEG_WAITS] = { IDLE | UNDER_WAY, { OPC4_SHIFT_STATE_HOLD, OPC4_SHIFT_STATE_HOLD } },
    [WINDOW_ENTERED] = { PUSH, { OPC4_SHIFT_STATE_CONFIRM, OPC4_SHIFT_STATE_CONFIRM } },
    [WINDOW_LEFT] = { CONFIRM, { OPC4_SHIFT_STATE_PUSH, OPC4_SHIFT_STATE_PUSH } },
    [CONFIRMED] = { DRIVING, { OPC4_SHIFT_STATE_BLOW, OPC4_SHIFT_STATE_BLOW } },
    [SLIPPED] = { BLOW, { OPC4_SHIFT_STATE_PUSH, OPC4_SHIFT_STATE_PUSH } },
    [SHIFT_DONE] = { DRIVING | BLOW, { OPC4_SHIFT_STATE_HOLD, OPC4_SHIFT_STATE_HOLD } },
    [WAIT_CANCELLED] = { HOLD, { OPC4_SHIFT_STATE_VENT, OPC4_SHIFT_STATE_VENT } },
    [HOLD_OVER] = { HOLD, { OPC4_SHIFT_STATE_VENT, OPC4_SHIFT_STATE_VENT } },
    [VENT_OVER] = { VENT, { OPC4_SHIFT_STATE_IDLE, OPC4_SHIFT_STATE_IDLE } },
    [RETRY] = { DRIVING, { OPC4_SHIFT_STATE_VENT, OPC4_SHIFT_STATE_VENT } },
    [PAUSE_OVER] = { VENT, { OPC4_SHIFT_STATE_PUSH, OPC4_SHIFT_STATE_PUSH } },
    [FAILED] = { DRIVING, { OPC4_SHIFT_STATE_FAULT, OPC4_SHIFT_STATE_FAULT } },
    [POSITION_LOST] = { INIT | IDLE | UNDER_WAY | FAULT, { OPC4_SHIFT_STATE_INIT, OPC4_SHIFT_STATE_FAULT } },
    [RECOVERED] = { FAULT, { OPC4_SHIFT_STATE_INIT, OPC4_SHIFT_STATE_INIT } },
};

enum agreement { SPEEDS_UNKNOWN, SPEEDS_APART, SPEEDS_AGREE };

/* What the machine observes in a step; `requested` is UNKNOWN without a valid request. */
struct observation {
    int64_t now_ns;
    bool position_valid, moved, clear_b, clear_f, recoverable;
    enum opc4_gear gear, requested;
    int64_t run;
    enum agreement speeds;
};

static struct {
    enum opc4_shift_state state;
    enum event event;                         /* of the latest step */
    enum opc4_gear confirmed, leg, final;     /* leg: of the present push, or of the next one */
    enum opc4_gear served;                    /* the last request that was served, or failed */
    unsigned raised;                          /* faults */
    int64_t attempt, attempt_ns, leg_ns, earliest_ns, until_ns, init_ns;
    bool has_init, is_pending;                /* pending: HOLD or VENT before a push */

    int64_t init_samples, init_timeout_ns, push_timeout_ns, retry_pause_ns, no_motion_ns, settle_ns;
    int64_t hold_ns, vent_ns, sync_wait_ns;
} machine;

static void shift_init(void)
{
    const int64_t sensor_ns = opc4_ns(settings->sensor.period_s);
    machine.init_samples = (opc4_ns(settings->shift.init_settle_s) + sensor_ns - 1) / sensor_ns;
    if (machine.init_samples < settings->windows.samples)
        machine.init_samples = settings->windows.samples;
    machine.init_timeout_ns = opc4_ns(settings->shift.init_timeout_s);
    machine.push_timeout_ns = opc4_ns(settings->shift.push_timeout_s);
    machine.retry_pause_ns = opc4_ns(settings->shift.retry_pause_s);
    machine.no_motion_ns = opc4_ns(settings->shift.no_motion_s);
    machine.settle_ns = opc4_ns(settings->shift.reversal_settle_s);
    machine.hold_ns = opc4_ns(settings->shift.hold_s);
    machine.vent_ns = opc4_ns(settings->shift.vent_s);
    machine.sync_wait_ns = opc4_ns(settings->shift.sync_wait_s);
    machine.confirmed = machine.leg = machine.final = machine.served = OPC4_GEAR_UNKNOWN;
}

static bool is_in(unsigned states)
{
    return (1u << machine.state & states) != 0;
}

/* Whether a requested gear is still to be reached. */
static bool is_in_process(void)
{
    if (machine.state == OPC4_SHIFT_STATE_BLOW)
        return machine.final != machine.leg;
    return is_in(DRIVING) || machine.is_pending;
}

static void change(enum event event)
{
    if (!is_in(transitions[event].from))
        opc4_fail("a transition that the table does not have");
    machine.event = event;
    machine.state = transitions[event].to[is_in(INIT | IDLE) ? 0 : 1];
}

static void give_up(unsigned fault)
{
    machine.confirmed = OPC4_GEAR_UNKNOWN;
    machine.raised = fault;
    machine.served = machine.final;
    machine.is_pending = false;
}

/* Give up a push and enter FAULT; the request that led here counts as served. */
static void shift_fail(unsigned fault)
{
    change(FAILED);
    give_up(fault);
}

static void lose_position(void)
{
    machine.confirmed = OPC4_GEAR_UNKNOWN;
    if (is_in(UNDER_WAY))
        give_up(OPC4_FAULT_NONE);
    change(POSITION_LOST);
    machine.has_init = false;
}

static void step_init(const struct observation *seen)
{
    if (!machine.has_init) {
        machine.has_init = true;
        machine.init_ns = seen->now_ns;
    }
    if (seen->gear != OPC4_GEAR_UNKNOWN && seen->run >= machine.init_samples) {
        machine.confirmed = seen->gear;
        change(GEAR_FOUND);
    } else if (seen->now_ns - machine.init_ns >= machine.init_timeout_ns) {
        change(INIT_TIMEOUT);
    }
}

static void step_fault(const struct observation *seen)
{
    if (seen->recoverable && seen->requested != OPC4_GEAR_UNKNOWN && seen->requested != machine.served) {
        machine.has_init = false;
        machine.served = OPC4_GEAR_UNKNOWN; /* the failed request is a new one if it comes back */
        change(RECOVERED);
    }
}

/* Confirm a gear in whose window the stay has been long enough. */
static void confirm_again(const struct observation *seen, enum opc4_gear gear)
{
    if (seen->gear == gear && seen->run >= settings->windows.samples)
        machine.confirmed = gear;
}

/* Whether the push must wait: for the opposite chamber, or for the shaft speeds. */
static bool is_held_back(const struct observation *seen)
{
    if (machine.leg == OPC4_GEAR_NEUTRAL)
        return false;
    const bool is_clear = machine.leg == OPC4_GEAR_BACKWARD ? seen->clear_b : seen->clear_f;
    const bool waits = settings->shift.wait_for_sync != 0 && seen->speeds == SPEEDS_APART
                       && seen->now_ns < machine.until_ns;
    return waits || !is_clear;
}

static void push_now(const struct observation *seen)
{
    machine.confirmed = OPC4_GEAR_UNKNOWN; /* from here on the sensor reports the position late or never */
    machine.is_pending = false;
    machine.leg_ns = machine.attempt_ns = machine.earliest_ns = seen->now_ns;
    if (seen->gear == machine.leg)
        machine.earliest_ns += machine.settle_ns;
    change(LEG_STARTED);
}

static void start_leg(const struct observation *seen, enum opc4_gear leg)
{
    machine.leg = leg;
    machine.attempt = 0;
    machine.until_ns = seen->now_ns + machine.sync_wait_ns;
    if (is_held_back(seen)) {
        machine.is_pending = true;
        change(LEG_WAITS);
    } else {
        push_now(seen);
    }
}

/* Begin a shift if there is a new request; return whether one began. */
static bool serve(const struct observation *seen)
{
    if (seen->requested == OPC4_GEAR_UNKNOWN)
        return false;
    if (seen->requested == machine.confirmed)
        machine.served = seen->requested;
    if (seen->requested == machine.served)
        return false;
    machine.final = seen->requested;
    const bool straight = machine.final == OPC4_GEAR_NEUTRAL || machine.confirmed == OPC4_GEAR_NEUTRAL;
    start_leg(seen, straight ? machine.final : OPC4_GEAR_NEUTRAL);
    return true;
}

static enum opc4_gear requested_or_neutral(const struct observation *seen)
{
    return seen->requested == OPC4_GEAR_UNKNOWN ? OPC4_GEAR_NEUTRAL : seen->requested;
}

/* Act on a changed or lost request during a leg; return whether the leg was given up. */
static bool follow_request(const struct observation *seen)
{
    if (machine.leg == OPC4_GEAR_NEUTRAL) {
        machine.final = requested_or_neutral(seen);
    } else if (seen->requested != OPC4_GEAR_UNKNOWN && seen->requested != machine.leg) {
        machine.final = seen->requested;
        start_leg(seen, OPC4_GEAR_NEUTRAL);
        return true;
    }
    return false;
}

static bool is_blow_over(const struct observation *seen)
{
    if (settings->blow.cut == OPC4_CUT_SYNC && machine.final != machine.leg && seen->speeds == SPEEDS_AGREE)
        return true;
    return seen->now_ns >= machine.until_ns;
}

static void after_blow(const struct observation *seen)
{
    if (machine.final != machine.leg) {
        start_leg(seen, machine.final);
    } else {
        machine.served = machine.final;
        machine.until_ns = seen->now_ns + machine.hold_ns;
        change(SHIFT_DONE);
    }
}

/* How long the safety blow lasts; blow cut ends it early. */
static double blow_s(void)
{
    const double configured_s = settings->blow.cut == OPC4_CUT_CONFIRMATION ? 0.0 : settings->blow.duration_s;
    const bool follows_neutral = machine.leg == OPC4_GEAR_NEUTRAL && machine.final != machine.leg;
    const double limit_s = follows_neutral ? settings->blow_cut.neutral_s : settings->blow_cut.otherwise_s;
    return settings->strategy == OPC4_STRATEGY_BLOW_CUT && limit_s < configured_s ? limit_s : configured_s;
}

static void begin_blow(const struct observation *seen)
{
    machine.until_ns = seen->now_ns + opc4_ns(blow_s());
    if (is_blow_over(seen))
        after_blow(seen);
    else
        change(CONFIRMED);
}

static void step_push(const struct observation *seen)
{
    const bool is_there = seen->gear == machine.leg;
    if (follow_request(seen))
        return;
    if (is_there && seen->run >= settings->windows.samples && seen->now_ns >= machine.earliest_ns) {
        machine.confirmed = machine.leg;
        begin_blow(seen);
    } else if (!is_there && !seen->moved && seen->now_ns - machine.leg_ns >= machine.no_motion_ns) {
        shift_fail(OPC4_FAULT_SENSOR_STUCK);
    } else if (seen->now_ns - machine.attempt_ns < machine.push_timeout_ns) {
        if (is_there != is_in(CONFIRM))
            change(is_there ? WINDOW_ENTERED : WINDOW_LEFT);
    } else if (machine.attempt < settings->shift.retries) {
        machine.attempt++;
        machine.is_pending = true;
        machine.until_ns = seen->now_ns + machine.retry_pause_ns;
        change(RETRY);
    } else {
        shift_fail(OPC4_FAULT_SHIFT_TIMEOUT);
    }
}

static void step_blow(const struct observation *seen)
{
    if (follow_request(seen))
        return;
    confirm_again(seen, machine.leg);
    const bool is_over = is_blow_over(seen);
    const bool has_left = seen->gear != machine.leg && seen->run >= settings->windows.samples;
    if (has_left || (is_over && machine.confirmed != machine.leg))
        change(SLIPPED); /* the same push goes on */
    else if (is_over)
        after_blow(seen);
}

static void enter_vent(const struct observation *seen, enum event event)
{
    machine.until_ns = seen->now_ns + machine.vent_ns;
    change(event);
}

/* Hold before a push into gear, until nothing holds it back or the request changes. */
static void wait_in_neutral(const struct observation *seen)
{
    machine.final = requested_or_neutral(seen);
    if (machine.confirmed != OPC4_GEAR_NEUTRAL) {
        start_leg(seen, OPC4_GEAR_NEUTRAL);
    } else if (machine.final == OPC4_GEAR_NEUTRAL) {
        machine.leg = machine.served = OPC4_GEAR_NEUTRAL;
        machine.is_pending = false;
        enter_vent(seen, WAIT_CANCELLED);
    } else {
        machine.leg = machine.final;
        if (!is_held_back(seen))
            push_now(seen);
    }
}

static void step_hold(const struct observation *seen)
{
    if (machine.is_pending) {
        wait_in_neutral(seen);
        return;
    }
    confirm_again(seen, machine.leg);
    if (!serve(seen) && seen->now_ns >= machine.until_ns)
        enter_vent(seen, HOLD_OVER);
}

static void step_vent(const struct observation *seen)
{
    if (machine.is_pending) { /* between two attempts of a leg */
        if (!follow_request(seen) && seen->now_ns >= machine.until_ns) {
            machine.is_pending = false;
            machine.attempt_ns = seen->now_ns;
            change(PAUSE_OVER);
        }
        return;
    }
    confirm_again(seen, machine.leg);
    if (!serve(seen) && seen->now_ns >= machine.until_ns)
        change(VENT_OVER);
}

/* Make at most one transition. */
static void shift_step(const struct observation *seen)
{
    machine.event = NO_EVENT;
    machine.raised = OPC4_FAULT_NONE;
    if (!seen->position_valid) {
        lose_position();
        return;
    }
    if (machine.confirmed != seen->gear)
        machine.confirmed = OPC4_GEAR_UNKNOWN;
    switch (machine.state) {
    case OPC4_SHIFT_STATE_INIT: step_init(seen); break;
    case OPC4_SHIFT_STATE_IDLE:
        confirm_again(seen, seen->gear);
        (void)serve(seen);
        break;
    case OPC4_SHIFT_STATE_PUSH:
    case OPC4_SHIFT_STATE_CONFIRM: step_push(seen); break;
    case OPC4_SHIFT_STATE_BLOW: step_blow(seen); break;
    case OPC4_SHIFT_STATE_HOLD: step_hold(seen); break;
    case OPC4_SHIFT_STATE_VENT: step_vent(seen); break;
    case OPC4_SHIFT_STATE_FAULT: step_fault(seen); break;
    }
}
