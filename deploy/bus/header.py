"""A C header for the gateway's side: identifiers, periods, data ids, packing of every signal, and the CRC, all from the DBC.

cantools generates the C source that packs and unpacks (`cantools generate_c_source <dbc>`); this
header adds what it leaves out, the end-to-end protection and the times, so that gateway and PC go
by one file.
"""

from __future__ import annotations

import re

from deploy.bus.description import Description
from deploy.bus.protection import FINAL, MAX_STEP, START, TABLE

PREFIX = "BROKK"


def c_header(description: Description) -> str:
    """Returns the text of the header."""
    lines = [
        f"/* Made from {description.name}: do not edit. Packing and unpacking: cantools generate_c_source. */",
        f"#ifndef {PREFIX}_BUS_H",
        f"#define {PREFIX}_BUS_H",
        "#include <stdint.h>",
        "",
        f"#define {PREFIX}_COUNTER_MAX_STEP {MAX_STEP}u",
    ]
    for layout in description.layouts.values():
        name = f"{PREFIX}_{_upper(layout.name)}"
        lines += [
            "",
            f"#define {name}_ID 0x{layout.frame_id:X}u",
            f"#define {name}_EXTENDED {int(layout.extended)}",
            f"#define {name}_LENGTH {layout.length}u",
            f"#define {name}_PERIOD_MS {round(1e3 * layout.period_s)}u",
        ]
        if layout.data_id is not None:
            lines += [
                f"#define {name}_DATA_ID 0x{layout.data_id:X}u",
                f"#define {name}_CRC_BYTE {layout.crc_byte}u",
                f"#define {name}_COUNTER_MODULUS {layout.modulus}u",
            ]
    values = ", ".join(f"0x{value:02X}" for value in TABLE)
    rows = re.findall(r"(?:0x..(?:, )?){1,16}", values)
    lines += [
        "",
        "/* CRC-8 SAE J1850 over the data, its CRC byte taken as zero, then the data id, low byte first. */",
        "static const uint8_t brokk_crc8_table[256] = {",
        *(f"  {row.rstrip(' ')}" for row in rows),
        "};",
        "static inline uint8_t brokk_crc8(const uint8_t *data, uint8_t length, uint8_t crc_byte, uint16_t data_id) {",
        f"  uint8_t crc = 0x{START:02X}u, i;",
        "  for (i = 0; i < length; i++) crc = brokk_crc8_table[crc ^ (i == crc_byte ? 0u : data[i])];",
        "  crc = brokk_crc8_table[crc ^ (data_id & 0xFFu)];",
        f"  return (uint8_t)(brokk_crc8_table[crc ^ (data_id >> 8)] ^ 0x{FINAL:02X}u);",
        "}",
        "#endif",
        "",
    ]
    return "\n".join(lines)


def _upper(name: str) -> str:
    """Returns `ValveCmd` as `VALVE_CMD`."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).upper()
