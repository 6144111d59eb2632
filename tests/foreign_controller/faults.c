/* Twelve faults of C, one a run: which one, says controller.windows.samples. Where: see the comments. */
#include "opc4.h"

static int32_t table[4], beyond = 7, largest = INT32_MAX;

static void overrun(int32_t *pointer)
{
    pointer[4] = 1;                                             /* pointer */
}

static int32_t recurse(volatile int32_t depth)
{
    volatile int32_t local[64] = { depth };                     /* recursion */
    return recurse(depth + 1) + local[depth % 64];
}

static int32_t maybe(int64_t flag)
{
    int32_t value;
    if (flag > 100)
        value = 3;
    return value;
}

static void do_fault(int64_t which)
{
    const int32_t size = (int32_t)which;
    int32_t *nothing = NULL;
    struct opc4_valve_command command = { 0.0, 0.0, 0.0, OPC4_GEAR_NEUTRAL };
    struct opc4_frame frame = { 0, { 0 }, 0x18FF9927u, 8 };
    switch (which) {
    case 11: *nothing = 1; break;                               /* null */
    case 12: table[size - 8] = 1; break;                        /* array */
    case 13: overrun(table); break;
    case 14: largest += size; break;                            /* overflow */
    case 15: beyond = 1 << (size + 25); break;                  /* shift */
    case 16: beyond = size / (size - 16); break;                /* division */
    case 17: while (beyond != 0) { beyond = 7; } break;         /* loop */
    case 18: beyond = recurse(1); break;
    case 19: command.duty_b = maybe(which) == 3 ? 0.5 : 0.0; opc4_send_valve_command(&command); break;
    case 20: frame.length = 9; opc4_send(&frame); break;        /* length */
    case 21: for (int k = 0; k < 10000; k++) { opc4_send(&frame); } break; /* flood */
    case 22:
        command.duty_n = (double)(beyond - 7) / (double)(beyond - 7);
        opc4_send_valve_command(&command);                      /* nan */
        break;
    }
}

void fw_init(void)
{
}

void fw_step(void)
{
    if (fw_in.now_ns == 50000000)
        do_fault(fw_in.settings.windows.samples);
}
