"""C header for the firmware of a gateway: identifiers, times and end-to-end protection of one DBC.

cantools generates the C source that packs and unpacks (`cantools generate_c_source <dbc>`); the
header adds `brokk_crc8` and `brokk_take`, which decide about a message as `deploy.kernel.protection`
does. Gateway and PC then go by one file and one set of rules.
"""

from __future__ import annotations

import re

from brokk_rl.registry import resolve_package_path
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

RULES = "deploy:bus/gateway_rules.h"
"""C code that the header ends with; it needs the constants before it."""


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
    for name, value in description.identity.items():
        constants[_convert_to_upper_snake(name)] = f"0x{value:06X}u"
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
    rules = resolve_package_path(RULES).read_text()
    return "\n".join([*lines, "", rules, "#endif", ""])


def _convert_to_upper_snake(name: str) -> str:
    """Return `ValveCmd` as `VALVE_CMD`."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).upper()
