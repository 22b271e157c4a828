"""Mistakes of deployment code behind the network, and another network in its place."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from diagnosis.deployment.contract import LoadedPolicy
from diagnosis.deployment.distortions import (
    LEVELS,
    MAX_DELAY,
    MAX_HOLD,
    SMOOTHING,
    Build,
    Distortion,
    describe_order,
    keep_fixed,
    list_factors,
    list_groups,
    make_fixed,
)
from diagnosis.deployment.orders import Order, list_orders
from diagnosis.deployment.replay import Change, Transform
from diagnosis.deployment.transforms import (
    arrange_columns,
    clip_columns,
    delay_rows,
    hold_rows,
    shift_command,
    smooth_rows,
)


def make_command_order(names: list[str], order: Order) -> Distortion:
    """Return the mistake that commands reach the joints in another order."""
    text = "commands reach the joints in another order: " + describe_order(names, order)
    return Distortion("order", "command", text, make_fixed(Change(command=arrange_columns(order))))


def list_command_distortions(policy: LoadedPolicy) -> list[Distortion]:
    """Return mistakes between network and valve."""
    names, found = list(policy.contract.joints), list[Distortion]()

    def make(transform: Callable[[float], Transform]) -> Build:
        return lambda value: Change(command=transform(value))

    for order in list_orders(names):
        found.append(make_command_order(names, order))
    for columns, label in list_groups(names):
        place = "command" + label
        found += list_factors(place, columns, make)
        found.append(
            Distortion(
                "clip",
                place,
                f"{place} is clipped at ±{{value}}",
                make(lambda value, columns=columns: clip_columns(columns, value)),
                tuple(level for level in LEVELS if level < 1.0),
                True,
                "bound",
            )
        )
        found.append(
            Distortion(
                "default_pose",
                place,
                f"{{value}} is added to {place}",
                make(lambda value, columns=columns: shift_command(columns, value)),
                (-0.3, -0.1, -0.03, 0.03, 0.1, 0.3),
                True,
                "offset",
            )
        )
    delays = tuple(float(number) for number in range(1, MAX_DELAY + 1))
    found.append(
        Distortion(
            "delay",
            "command",
            "the command is {value} periods late",
            make(delay_rows),
            delays,
            False,
            "periods",
        )
    )
    for hold in range(2, MAX_HOLD + 1):
        for phase in range(hold):
            text = f"a command is held for {hold} periods: the policy runs at 1/{hold} of its rate"
            found.append(
                Distortion("rate", "command", text, make(keep_fixed(hold_rows(hold, phase))))
            )
    found.append(
        Distortion(
            "filter",
            "command",
            "the command is low-pass filtered, newest weighs {value}",
            make(smooth_rows),
            SMOOTHING,
            True,
            "weight",
        )
    )
    return found


def list_network_distortions(
    policy: LoadedPolicy, others: Mapping[str, LoadedPolicy]
) -> list[Distortion]:
    """Return the mistake of having deployed each of the other policies, where it would run at all."""
    found = []
    for name, other in others.items():
        if other.contract.size != policy.contract.size:
            continue
        change = Change(network=other.network)
        found.append(
            Distortion("network", "network", f"the network is that of {name}", make_fixed(change))
        )
    return found
