/* A firmware of your own in C: it pushes until the sensor shows the gear, then vents.
 *
 *     opc4 firmware --check THIS_FILE
 *     opc4 run lab_n_b --set firmware=THIS_FILE
 *
 * opc4.h describes what comes in and goes out. Change what you want to try. */
#include "opc4.h"

#define DUTY 0.98               /* opens a valve */
#define TOLERANCE_M 0.0015      /* of neutral and of both end positions */
#define SAMPLES_TO_CONFIRM 3

static struct opc4_channel requests, pulses;
static enum opc4_gear requested, seen;          /* of the driver; where the sensor shows the stay */
static int32_t samples, taken;                  /* in a row that show it there; since the start */
static double position_m;                       /* from neutral, backward positive */

static enum opc4_gear gear_at(double at_m)
{
    const double engaged_m = fw_in.settings.windows.stroke_m - TOLERANCE_M;
    if (at_m > engaged_m)
        return OPC4_GEAR_BACKWARD;
    if (at_m < -engaged_m)
        return OPC4_GEAR_FORWARD;
    return at_m < TOLERANCE_M && at_m > -TOLERANCE_M ? OPC4_GEAR_NEUTRAL : OPC4_GEAR_UNKNOWN;
}

static void take_pulse(const struct opc4_position_pulse *pulse)
{
    const double warmth = 1.0 + fw_in.settings.sensor.temp_coeff_per_k
                                    * (pulse->coil_temperature_k - fw_in.settings.sensor.t_ref_k);
    position_m = (pulse->pulse_s / warmth - fw_in.settings.sensor.t_mid_s) / fw_in.settings.sensor.slope_s_per_m;
    samples = gear_at(position_m) == seen ? samples + 1 : 1;
    seen = gear_at(position_m);
    taken += taken < SAMPLES_TO_CONFIRM;
}

static void take(const struct opc4_frame *frame)
{
    struct opc4_shift_request request;
    struct opc4_position_pulse pulse;
    if (frame->id == OPC4_SHIFT_REQUEST_ID) {
        const bool is_sound = opc4_unpack_shift_request(frame, &request);
        if (opc4_receive(&requests, frame, opc4_shift_request_data_ids, is_sound))
            requested = request.target;
    } else if (frame->id == OPC4_POSITION_PULSE_ID) {
        const bool is_sound = opc4_unpack_position_pulse(frame, &pulse);
        if (opc4_receive(&pulses, frame, opc4_position_pulse_data_ids, is_sound))
            take_pulse(&pulse);
    }
}

void fw_init(void)
{
    requests.timeout_ns = opc4_ns(fw_in.settings.e2e.request_timeout_s);
    pulses.timeout_ns = opc4_ns(fw_in.settings.e2e.position_timeout_s);
    requested = seen = OPC4_GEAR_UNKNOWN;
}

/* Called once a period of simulated time. */
void fw_step(void)
{
    for (uint32_t k = 0; k < fw_in.count; k++)
        take(&fw_in.frames[k]);
    const bool trusted = opc4_state(&pulses, fw_in.now_ns) == OPC4_E2E_STATE_VALID
                      && opc4_state(&requests, fw_in.now_ns) == OPC4_E2E_STATE_VALID;
    const bool is_there = seen == requested && samples >= SAMPLES_TO_CONFIRM;
    const bool pushes = trusted && !is_there && taken >= SAMPLES_TO_CONFIRM;

    struct opc4_valve_command valves = { 0.0, 0.0, 0.0, requested };
    if (pushes && requested == OPC4_GEAR_BACKWARD)
        valves.duty_b = DUTY;
    if (pushes && requested == OPC4_GEAR_NEUTRAL)
        valves.duty_n = DUTY;
    if (pushes && requested == OPC4_GEAR_FORWARD)
        valves.duty_f = DUTY;
    const struct opc4_safety_blow blow = { OPC4_CHAMBER_NONE, false, 0.0 };
    const struct opc4_controller_status status = {
        pushes ? OPC4_SHIFT_STATE_PUSH : OPC4_SHIFT_STATE_IDLE,
        is_there ? requested : OPC4_GEAR_UNKNOWN,
        position_m,
        OPC4_FAULT_NONE,
    };
    opc4_send_valve_command(&valves);
    opc4_send_safety_blow(&blow);
    opc4_send_controller_status(&status);
    opc4_trace("samples", samples);     /* a column of firmware.csv */
}
