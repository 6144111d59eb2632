/* A controller of the gear shift in plain C: joins a lockstep run over SocketCAN in place of ours.
 *
 *     python -m sil.c_header > contract.h
 *     cc -O2 -I . -o controller controller.c && ./controller vcan0
 *
 * It knows the CAN contract (contract.h: identifiers and E2E data ids out of opc4.dbc) and the
 * lockstep protocol (sil/transports/wire.py), nothing else.  Its firmware is the simplest that
 * shifts: push until the sensor shows the gear in three samples, blow for 150 ms, vent.  Exit code
 * 0: the run ended regularly. */
#include <linux/can.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <poll.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <unistd.h>

#include "contract.h"

enum { ME = 2, VERSION = 1, TICK_NS = 10000000, BLOW_NS = 150000000 };
enum {  /* lockstep frames; an offer is a frame with EDP set */
    EDP = 1 << 25,
    START = 0x1FFF00F9, STOP = 0x1FFF01F9, GRANT = 0x1FFF02F9, BUS_TIME = 0x1FFF03F9,
    DONE = 0x1FFF04FA, HELLO = 0x1FFF06FA, WELCOME = 0x1FFF07F9, REFUSED = 0x1FFF08F9,
    SYNC = 0x1FFF0AF9, ACK = 0x1FFF0BFA
};
enum gear { NEUTRAL, BACKWARD, FORWARD, UNKNOWN };
enum state { INIT, IDLE, PUSH, CONFIRM, BLOW };

static int can;
static unsigned offered;

/* --- frames ---------------------------------------------------------------------------------- */
static void put(uint32_t id, const uint8_t data[8])
{
    struct can_frame frame = { .can_id = id | CAN_EFF_FLAG, .can_dlc = 8 };
    memcpy(frame.data, data, 8);
    while (write(can, &frame, sizeof frame) != sizeof frame)
        usleep(500);                             /* the interface's queue is full */
}

static void control(uint32_t id, uint8_t participant, uint8_t extra, uint64_t value)
{
    uint8_t data[8] = { participant, extra };
    for (int i = 0; i < 6; i++)
        data[2 + i] = value >> 8 * i;
    put(id, data);
}

static uint64_t value_of(const uint8_t data[8])
{
    uint64_t value = 0;
    for (int i = 5; i >= 0; i--)
        value = value << 8 | data[2 + i];
    return value;
}

static uint8_t crc8_2f(const uint8_t data[8], uint8_t data_id)  /* AUTOSAR E2E profile 2 */
{
    uint8_t crc = 0xFF;
    for (int i = 1; i <= 8; i++) {
        crc ^= i < 8 ? data[i] : data_id;
        for (int bit = 0; bit < 8; bit++)
            crc = crc & 0x80 ? crc << 1 ^ 0x2F : crc << 1;
    }
    return crc ^ 0xFF;
}

static int is_sound(const struct can_frame *frame, const uint8_t ids[16])
{
    return frame->can_dlc == 8 && frame->data[0] == crc8_2f(frame->data, ids[frame->data[1] & 15]);
}

static void offer(uint32_t id, uint8_t data[8], const uint8_t ids[16], unsigned counter)
{
    data[1] = (data[1] & 0xF0) | (counter & 15);
    data[0] = crc8_2f(data, ids[counter & 15]);
    put(id | EDP, data);
    offered++;
}

/* --- the firmware ---------------------------------------------------------------------------- */
static enum state state = INIT;
static enum gear wanted = UNKNOWN, target = UNKNOWN, confirmed = UNKNOWN, seen = UNKNOWN;
static double position_m;
static int samples;
static uint64_t blow_end_ns;

static void hear(const struct can_frame *frame)
{
    uint32_t id = frame->can_id & CAN_EFF_MASK;
    const uint8_t *d = frame->data;
    if (id == SHIFT_REQUEST && is_sound(frame, SHIFT_REQUEST_IDS))
        wanted = d[1] >> 4 & 3;
    if (id == POSITION_PULSE && is_sound(frame, POSITION_PULSE_IDS)) {
        double pulse_s = (d[2] | d[3] << 8) * 0.0625e-6, coil_k = (d[4] | d[5] << 8) * 0.03125;
        position_m = (pulse_s / (1.0 + 0.0012 * (coil_k - 293.15)) - 0.0009) / 0.022;
        enum gear now = position_m > 0.0119 ? BACKWARD : position_m < -0.0119 ? FORWARD
            : position_m > -0.001 && position_m < 0.001 ? NEUTRAL : UNKNOWN;
        samples = now == seen ? samples + 1 : 1;
        seen = now;
    }
}

static void step(uint64_t now_ns)
{
    static unsigned counter;
    int settled = samples >= 3 ? (int)seen : UNKNOWN;
    if ((state == INIT && settled != UNKNOWN) || (state == BLOW && now_ns >= blow_end_ns)) {
        state = IDLE;
        confirmed = settled;
    } else if (state == IDLE && wanted != UNKNOWN && wanted != confirmed) {
        state = PUSH;
        target = wanted == NEUTRAL || confirmed == NEUTRAL ? wanted : NEUTRAL;
        confirmed = UNKNOWN;
    } else if (state == PUSH && settled == (int)target) {
        state = BLOW;
        confirmed = target;
        blow_end_ns = now_ns + BLOW_NS;
    }
    int chamber = target == BACKWARD ? 0 : target == NEUTRAL ? 1 : 2;
    unsigned left = state == BLOW ? (blow_end_ns - now_ns) / 62500 : 0;  /* 1/16 ms */
    int estimate = position_m / 0.0625e-6;
    uint8_t valves[8] = { 0, 0xC0 | (state == PUSH ? target : UNKNOWN) << 4 };
    uint8_t blow[8] = { 0, (state == BLOW ? chamber : 3) << 4 | (state == BLOW) << 6,
                        left, left >> 8, 255, 255, 255, 255 };
    uint8_t status[8] = { 0, state << 4, 0xFC | confirmed, 0,
                          estimate, estimate >> 8, estimate >> 16, 255 };
    if (state == PUSH)
        valves[2 + 2 * chamber + 1] = 0x31;      /* 98 % in steps of 1/128 % */
    offer(VALVE_COMMAND, valves, VALVE_COMMAND_IDS, counter);
    offer(SAFETY_BLOW, blow, SAFETY_BLOW_IDS, counter);
    offer(CONTROLLER_STATUS, status, CONTROLLER_STATUS_IDS, counter++);
}

/* --- the lockstep ---------------------------------------------------------------------------- */
int main(int count, char **arguments)
{
    struct sockaddr_can address = { .can_family = AF_CAN };
    struct can_filter filters[] = {  /* everything but other participants' offers */
        { CAN_EFF_FLAG, CAN_EFF_FLAG | EDP }, { CAN_EFF_FLAG | 3 << 24, CAN_EFF_FLAG | 3 << 24 } };
    struct can_frame frame;
    unsigned nonce = getpid() & 0xFFFF, heard = 0, sender = 0;
    int joined = 0;
    can = socket(AF_CAN, SOCK_RAW, CAN_RAW);
    address.can_ifindex = if_nametoindex(count > 1 ? arguments[1] : "vcan0");
    setsockopt(can, SOL_CAN_RAW, CAN_RAW_FILTER, filters, sizeof filters);
    if (can < 0 || !address.can_ifindex || bind(can, (struct sockaddr *)&address, sizeof address))
        return perror("SocketCAN"), 2;
    for (;;) {
        struct pollfd ready = { .fd = can, .events = POLLIN };
        if (!joined && poll(&ready, 1, 100) == 0) {
            control(HELLO, ME, VERSION, nonce);  /* scenario 0: any */
            continue;
        }
        if (read(can, &frame, sizeof frame) != sizeof frame)
            return perror("read"), 3;
        uint32_t id = frame.can_id & CAN_EFF_MASK;
        uint64_t value = value_of(frame.data);
        int mine = frame.data[0] == ME;
        if (!(id & EDP)) {
            heard += sender != ME;
            hear(&frame);
        } else if (id == BUS_TIME) {
            sender = frame.data[0];
        } else if (id == WELCOME && mine && value == nonce) {
            joined = 1;
        } else if (id == REFUSED && mine && value == nonce) {
            return fprintf(stderr, "refused: reason %d\n", frame.data[1]), 2;
        } else if (id == START && joined) {
            control(DONE, ME, 0, 0);
        } else if (id == SYNC && mine) {
            control(ACK, ME, 255, ((uint64_t)1 << 48) - 1);
        } else if (id == GRANT && mine && joined) {
            if (frame.data[1] != (heard & 255))
                return fprintf(stderr, "frames lost: %u of %d heard\n", heard, frame.data[1]), 3;
            heard = offered = 0;
            if (value % TICK_NS == 0)            /* else the run ends between two ticks */
                step(value);
            control(DONE, ME, offered, (value / TICK_NS + 1) * TICK_NS);
        } else if (id == STOP && joined) {
            return frame.data[0] == 0 ? 0 : 3;
        }
    }
}
