"""What a diagnosis weighed, as plain JSON: enough to choose again at other prices, without simulating anything.

Axes: `J` joints, `E` entries, `B` blocks of entries that hang together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from diagnosis.engine import Findings, Prices
from diagnosis.evidence import Evidence
from diagnosis.found import Found
from diagnosis.library import Kind, shared
from diagnosis.search import Chosen, Scored, Subset, Table, choose, promising
from diagnosis.sizes import plain


def weighed(findings: Findings, prices: Prices) -> dict[str, Any]:
    """Returns what was weighed."""
    joints, common = [], shared(ways[0].kind for ways in findings.rays.values() if ways)
    for j, table in enumerate(findings.tables):
        priced = {*promising(table, prices.joint, prices.share, common)}
        rows = []
        for subset in sorted(table.scored, key=sorted):
            if subset in priced:
                null = findings.price(j, subset) - prices.joint * len(subset - common)
                rows.append(
                    _row(table, subset) | {"null": round(null / max(prices.reference, 1e-9), 2)}
                )
            elif subset and (len(subset) < 3 or any(subset < larger for larger in priced)):
                rows.append(_row(table, subset) | {"gain": round(table.scored[subset].total, 2)})
        joints.append({"felt": sorted(table.shapes), "subsets": rows})
    return {
        "joints": joints,
        "others": [{"effect": one.kind.name, "joints": one.joints.tolist(), "worth": one.worth, "gain": one.gain,
                    "rivals": dict(one.rivals)} for one in findings.others],
        "left": findings.left.tolist(), "left_null": findings.left_null.tolist(), "scatter": findings.scatter.tolist(),
        "strays": findings.strays.tolist(), "tool_left": findings.tool_left, "entries": findings.evidence.z.shape[1],
        "blocks": int(findings.evidence.block.max()) + 1,
        "prices": {"joint": prices.joint, "name": prices.name},
    }  # fmt: skip


def _row(table: Table, subset: Subset) -> dict[str, Any]:
    scored = table.scored[subset]
    sizes = {name: [round(float(v), 3) for v in size] for name, size in scored.sizes.items()}
    gain = np.bincount(table.block, scored.gain)
    return {"effects": sorted(subset), "gain": [round(float(v), 2) for v in gain], "sizes": sizes}


def findings(told: Mapping[str, Any], prices: Prices, kinds: Sequence[Kind]) -> Findings:
    """Returns the findings at other prices; evidence, repair and rays are those that choosing and saying need, no more."""
    tables, nulls, count = [], [], told["blocks"]
    for joint in told["joints"]:
        table = Table(
            plain(np.zeros(count), []), {name: [] for name in joint["felt"]}, np.arange(count)
        )
        for row in joint["subsets"]:
            sizes = {name: np.array(size) for name, size in row["sizes"].items()}
            gain = np.array(row["gain"]) if "null" in row else np.full(count, row["gain"] / count)
            table.scored[frozenset(row["effects"])] = Scored(gain, sizes)
        tables.append(table)
        nulls.append(
            {frozenset(row["effects"]): row["null"] for row in joint["subsets"] if "null" in row}
        )

    def price(j: int, subset: Subset) -> float:
        return prices.joint * len(subset - shared(kinds)) + prices.reference * nulls[j].get(
            subset, 0.0
        )

    chosen = chosen_of(tables, price, prices, kinds)
    by_name = {kind.name: kind for kind in kinds}
    others = []
    for one in told["others"]:
        mask, was = np.array(one["joints"]), told["prices"]
        more = (was["joint"] - prices.joint) * (
            1 if by_name[one["effect"]].target.stochastic else mask.sum()
        )
        worth = one["worth"] + more + was["name"] - prices.name
        if worth > 0:
            others.append(
                Found(by_name[one["effect"]], mask, {}, worth, one["gain"], 0.0, one["rivals"])
            )
    evidence = cast(Evidence, SimpleNamespace(z=np.zeros((len(tables), told["entries"]))))
    left, left_null, scatter, strays = (
        np.array(told[name]) for name in ("left", "left_null", "scatter", "strays")
    )
    rays = {name: [] for joint in told["joints"] for name in joint["felt"]}
    return Findings(
        evidence,
        tables,
        rays,
        price,
        chosen,
        None,
        others,
        left,
        left_null,
        scatter,
        strays,
        told["tool_left"],
    )


def chosen_of(tables: Sequence[Table], price: Any, prices: Prices, kinds: Sequence[Kind]) -> Chosen:
    """Returns the set that is worth most at these prices."""
    return choose(
        tables, price, prices.name, prices.share, shared(kinds), prices.partial, prices.joint
    )
