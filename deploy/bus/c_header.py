"""C header for the firmware of a gateway: identifiers, times and end-to-end protection of one DBC.

cantools generates the C source that packs and unpacks (`cantools generate_c_source <dbc>`); the
header adds `brokk_crc8` and `brokk_take`, which decide about a message as `deploy.kernel.protection`
does. Gateway and PC then go by one file and one set of rules.
"""

from __future__ import annotations

import re

from deploy.bus.description import BusDescription
from deploy.kernel.protection import (
    BURST_S,
    FINAL,
    MASK,
    MAX_ERRORS,
    MAX_REPEATED,
    MAX_STEP,
    MIN_GOOD,
    MIN_GOOD_INIT,
    RATE_SLACK,
    START,
    TABLE,
    ChannelTrust,
    MessageFault,
)

PREFIX = "BROKK"
"""Prefix of every name in the header."""
ROW_BYTES = 16
"""Bytes of the CRC table in a row of the header."""
TENTHS = 10
"""Tenths of a ms in a ms: the rate is counted in them, without fractions."""

CODE = """
/* CRC-8 SAE J1850 over the data, its CRC byte taken as zero, then the data id, low byte first. */
static inline uint8_t brokk_crc8(const uint8_t *data, uint8_t length, uint8_t crc_byte, uint16_t data_id) {
  uint8_t crc = BROKK_CRC_START, i;
  for (i = 0; i < length; i++) crc = brokk_crc8_table[crc ^ (i == crc_byte ? 0u : data[i])];
  crc = brokk_crc8_table[crc ^ (data_id & 0xFFu)];
  return (uint8_t)(brokk_crc8_table[crc ^ (data_id >> 8)] ^ BROKK_CRC_FINAL);
}

/* Receiver's side of one message. Begin with all zero, then set modulus, period_ms, and wrap_ms: the
   ms after which its stamp wraps, 0 where it has none. */
typedef struct {
  uint16_t modulus, period_ms;
  uint32_t wrap_ms;
  uint8_t trust, heard, stamped, counter, good;
  uint32_t heard_ms, stamp_ms, debt;
  uint64_t errors, repeated;
} brokk_channel;

static inline uint8_t brokk_count_bits(uint64_t word) {
  uint8_t count = 0;
  for (; word; word &= word - 1u) count++;
  return count;
}

/* Count a message, good or not; returns the fault. Call it for a wrong length or CRC, and for a
   message that is too old: older than BROKK_ROUND_TRIP_MS (commands) or BROKK_REMOTE_MS (remote). */
static inline uint8_t brokk_count(brokk_channel *c, uint8_t fault) {
  uint8_t is_repeated = fault == BROKK_FAULT_REPEATED, is_wrong = fault && !is_repeated;
  c->errors = (c->errors << 1 | is_wrong) & BROKK_WINDOW_MASK;
  c->repeated = (c->repeated << 1 | is_repeated) & BROKK_WINDOW_MASK;
  if (!fault) {
    if (c->good < 255u) c->good++;
    if (c->good >= (c->trust == BROKK_TRUST_INIT ? BROKK_MIN_GOOD_INIT : BROKK_MIN_GOOD)) c->trust = BROKK_TRUST_VALID;
    return fault;
  }
  c->good = 0;
  if (brokk_count_bits(c->errors) > BROKK_MAX_ERRORS || brokk_count_bits(c->repeated) > BROKK_MAX_REPEATED ||
      fault == BROKK_FAULT_RATE) {
    c->trust = BROKK_TRUST_INVALID;
    c->errors = c->repeated = 0;
    c->stamped = 0;
  }
  return fault;
}

/* Check a message whose CRC is right; 0: use it, if trust is BROKK_TRUST_VALID. */
static inline uint8_t brokk_take(brokk_channel *c, uint8_t counter, uint32_t stamp_ms, uint32_t now_ms) {
  uint32_t elapsed_ms = now_ms - c->heard_ms, step;
  uint64_t paid = (uint64_t)elapsed_ms * BROKK_RATE_SLACK;
  uint8_t before = c->counter, first = !c->heard;
  c->heard_ms = now_ms;
  c->heard = 1;
  if (c->debt > BROKK_BURST) c->debt = BROKK_BURST;
  c->debt = (first || paid > c->debt ? 0u : (uint32_t)(c->debt - paid)) + 10u * c->period_ms;
  if (c->debt > BROKK_BURST) return brokk_count(c, BROKK_FAULT_RATE);
  if (c->stamped && elapsed_ms < c->wrap_ms / 2u &&
      (stamp_ms + c->wrap_ms - c->stamp_ms) % c->wrap_ms > c->wrap_ms / 2u)
    return brokk_count(c, BROKK_FAULT_LATE);
  c->stamp_ms = stamp_ms;
  c->stamped = 1;
  c->counter = counter;
  if (first) return brokk_count(c, 0u);
  step = (uint32_t)(counter + c->modulus - before) % c->modulus;
  if (step == 0u) return brokk_count(c, BROKK_FAULT_REPEATED);
  return brokk_count(c, step > BROKK_COUNTER_MAX_STEP ? BROKK_FAULT_SEQUENCE : 0u);
}
#endif
"""


def generate_c_header(
    description: BusDescription, round_trip_s: float, remote_s: float, command_s: float
) -> str:
    """Return the text of the header.

    Args:
        description: The bus.
        round_trip_s: Age of a command's stamp above which the gateway refuses it.
        remote_s: Age of the remote's stamp, and of its last message, above which it is lost.
        command_s: Age of the last command above which the gateway goes to zero flow.
    """
    constants: dict[str, str] = {
        "COUNTER_MAX_STEP": f"{MAX_STEP}u",
        "CRC_START": f"0x{START:02X}u",
        "CRC_FINAL": f"0x{FINAL:02X}u",
        "WINDOW_MASK": f"0x{MASK:X}ull",
        "MAX_ERRORS": f"{MAX_ERRORS}u",
        "MAX_REPEATED": f"{MAX_REPEATED}u",
        "MIN_GOOD_INIT": f"{MIN_GOOD_INIT}u",
        "MIN_GOOD": f"{MIN_GOOD}u",
        "BURST": f"{round(1e3 * TENTHS * BURST_S)}u /* tenths of a ms */",
        "RATE_SLACK": f"{round(TENTHS * RATE_SLACK)}u /* tenths */",
        "ROUND_TRIP_MS": f"{round(1e3 * round_trip_s)}u",
        "REMOTE_MS": f"{round(1e3 * remote_s)}u",
        "COMMAND_MS": f"{round(1e3 * command_s)}u",
    }
    for trust in ChannelTrust:
        constants[f"TRUST_{trust.name}"] = f"{trust.value}u"
    for number, fault in enumerate(MessageFault, start=1):
        constants[f"FAULT_{fault.name}"] = f"{number}u /* {fault.value} */"
    for layout in description.layouts.values():
        name = _convert_to_upper_snake(layout.name)
        constants |= {
            f"{name}_ID": f"0x{layout.frame_id:X}u",
            f"{name}_EXTENDED": f"{int(layout.extended)}",
            f"{name}_LENGTH": f"{layout.length}u",
            f"{name}_PERIOD_MS": f"{round(1e3 * layout.period_s)}u",
        }
        if layout.data_id is not None:
            constants |= {
                f"{name}_DATA_ID": f"0x{layout.data_id:X}u",
                f"{name}_CRC_BYTE": f"{layout.crc_byte}u",
                f"{name}_COUNTER_MODULUS": f"{layout.modulus}u",
                f"{name}_STAMP_STEP_MS": f"{round(1e3 * layout.stamp_step_s)}u",
                f"{name}_STAMP_WRAP_MS": f"{round(1e3 * layout.stamp_wrap_s)}u",
            }
    rows = []
    for first in range(0, len(TABLE), ROW_BYTES):
        row = ", ".join(f"0x{value:02X}" for value in TABLE[first : first + ROW_BYTES])
        rows.append(f"  {row},")
    rows[-1] = rows[-1].removesuffix(",")
    lines = [
        f"/* Made from {description.name}: do not edit. Packing and unpacking: cantools generate_c_source. */",
        f"#ifndef {PREFIX}_BUS_H",
        f"#define {PREFIX}_BUS_H",
        "#include <stdint.h>",
        "",
        *(f"#define {PREFIX}_{name} {value}" for name, value in constants.items()),
        "",
        "static const uint8_t brokk_crc8_table[256] = {",
        *rows,
        "};",
    ]
    return "\n".join(lines) + CODE


def _convert_to_upper_snake(name: str) -> str:
    """Return `ValveCmd` as `VALVE_CMD`."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).upper()
