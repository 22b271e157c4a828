"""The compiled simulation of one joint: command to spool, spool to path, for many candidates at once.

Warp compiles both kernels once for the processor or the GPU. Candidates that differ only behind the
spool share the path of the command, which takes half of the time.
Axes: `C` candidates, `D` distinct command paths, `T` samples, `S` sub-steps, `P` numbers.
"""

# pyright: reportIndexIssue=false, reportOperatorIssue=false, reportArgumentType=false
# pyright: reportAttributeAccessIssue=false, reportCallIssue=false
# Kernels are compiled by Warp; a type checker reads them as ordinary Python.

from __future__ import annotations

import warp as wp

from diagnosis.engine.servo import ServoPlace
from diagnosis.engine.valve import ValvePlace as Place

wp.config.log_level = wp.LOG_ERROR  # that a kernel is compiled or read is no news to people

NUM_POSE = 4
NUM_LOAD = 4
NUM_WAYS = 8
"""Four other joints, each opened one way or the other."""

WAKING_DEMAND = 0.005
"""Share of the flow at full speed from which on the pump gives its whole margin: it wakes as soon as a valve opens."""
FULL_MARGIN = 0.71
"""Rest of the pressure over the margin from which a valve has its full flow. With 0.5, 0.71 and 1.0 left-out parts of nine
machines of two makes are likelier by 2,495, 3,580 and 3,192 nats than with a pump that knows no load. The demand above is
chosen by hand."""
RUNNING_SHARE = 0.2
"""Pressure of a joint that moves, over the one that breaks it away. With 0, 0.2, 0.35 and 0.5 the law of breaking away
explains 6, 9, 10 and 12 of 17 joints with stiction of practice machines of two makes better than a dead band does, and
0, 0, 2 and 3 of 13 joints with a dead band."""
DRIFT_SPAN_S = wp.constant(wp.float64(600.0))
"""The drift is the change of speed over ten minutes, so that its prior is that of a working day."""


@wp.func
def _approach(step_s: wp.float64, time_s: wp.float64) -> wp.float64:
    """Return the share of a first-order lag that one step covers; all of it without a lag."""
    if time_s < wp.float64(1e-4):
        return wp.float64(1.0)
    return wp.float64(1.0) - wp.exp(-step_s / time_s)


@wp.kernel(enable_backward=False)
def simulate_spool(
    commands: wp.array2d[wp.float64],
    begins: wp.array[wp.int32],
    joint: int,
    period_s: wp.float64,
    substeps: int,
    integrates: int,
    numbers: wp.array2d[wp.float64],
    spool: wp.array2d[wp.float32],
):
    """Simulate the spool of each command path without its delay, `(D, T S)`, at the end of each sub-step."""
    d = wp.tid()
    zero = wp.float64(0.0)
    step_s = period_s / wp.float64(substeps)
    opening = _approach(step_s, numbers[d, Place.PILOT_LAG_S])
    closing_s = (
        numbers[d, Place.PILOT_LAG_S] * wp.exp(numbers[d, Place.LOG_CLOSING_RATIO])
        + numbers[d, Place.CLOSING_LAG_S]
    )
    closing = _approach(step_s, closing_s)
    second = _approach(step_s, numbers[d, Place.SPOOL_LAG_S])
    lagging = _approach(step_s, numbers[d, Place.COMMAND_LAG_S])
    # Of an orifice that fills a chamber in 2 T the mean delay is two thirds of T.
    filling = zero
    if numbers[d, Place.FILLING_S] > zero:
        filling = step_s / (wp.float64(1.5) * numbers[d, Place.FILLING_S])
    slope = wp.float64(1e9)
    if numbers[d, Place.SLOPE_TIME_S] > zero:
        slope = step_s / numbers[d, Place.SLOPE_TIME_S]
    width = wp.max(numbers[d, Place.HYSTERESIS], zero)
    limited = zero
    lagged = zero
    filled = zero
    pilot = zero
    follower = zero
    held = zero
    begin = wp.int32(-1)
    for k in range(commands.shape[0]):
        command = commands[k, joint]
        if begins[k] != begin:
            begin = begins[k]
            # A target was there before the recording.
            limited = command * wp.float64(1 - integrates)
            lagged = limited
            filled = limited
            pilot = limited
            follower = limited
            held = limited
        for i in range(substeps):
            limited += wp.clamp(command - limited, -slope, slope)
            lagged += lagging * (limited - lagged)
            behind = lagged - filled
            if filling > zero:
                most = filling * wp.sqrt(wp.abs(behind))
                behind = wp.clamp(behind, -most, most)
            filled += behind
            rate = opening
            if wp.abs(filled) < wp.abs(pilot):
                rate = closing
            pilot += rate * (filled - pilot)
            follower += second * (pilot - follower)
            held = wp.clamp(held, follower - width, follower + width)
            spool[d, k * substeps + i] = wp.float32(held)


@wp.func
def _open(before: wp.float64, now: wp.float64, band: wp.float64) -> wp.float64:
    """Return the mean opening behind the band while a spool moves from `before` to `now`.

    The opening at the end of a step would make the path a stepped function of lags and bands.
    """
    zero = wp.float64(0.0)
    half = wp.float64(0.5)
    if wp.max(before, now) <= band:
        return zero
    first = wp.max(before - band, zero)
    last = wp.max(now - band, zero)
    mean = half * (first + last)
    if first == zero and last > zero:
        mean *= last / (now - before)
    if last == zero and first > zero:
        mean *= first / (before - now)
    return mean


@wp.func
def _shape_flow(opened: wp.float64, curve: wp.float64, bend: wp.float64) -> wp.float64:
    """Return the flow through an opening over that of a full one: a line with two curvatures."""
    rest = wp.float64(1.0) - opened
    return opened * (wp.float64(1.0) + curve * rest + bend * rest * (wp.float64(0.5) - opened))


@wp.kernel(enable_backward=False)
def simulate_path(
    spool: wp.array2d[wp.float32],
    which: wp.array[wp.int32],
    begins: wp.array[wp.int32],
    poses: wp.array2d[wp.float64],
    loads: wp.array2d[wp.float64],
    load: wp.array[wp.float64],
    stops: wp.array[wp.int32],
    demand: wp.array[wp.float64],
    pressing: wp.array[wp.float64],
    opened_others: wp.array2d[wp.float64],
    time_s: wp.array[wp.float64],
    period_s: wp.float64,
    substeps: int,
    numbers: wp.array2d[wp.float64],
    path: wp.array2d[wp.float32],
    flow: wp.array2d[wp.float32],
):
    """Integrate the speed behind the spool `which` of each candidate to a path, `(C, T)`; keep its demand of flow.

    The pump rises to what the heaviest joint needs and a margin beyond it; pressures are counted in margins.
    A joint begins to move when the pump bears its own load. One that sticks stands until the pressure behind a piston that
    leaks breaks it away; that pressure is counted in the speed that it makes leak away.
    Sub-steps begin and end with the delayed ones of the spool, so that no change of a command lies
    within one, and the path is a smooth function of the delay.
    """
    c = wp.tid()
    one = wp.float64(1.0)
    zero = wp.float64(0.0)
    half = wp.float64(0.5)
    step = one / wp.float64(substeps)
    step_s = period_s * step
    delay = numbers[c, Place.DELAY_S] / step_s
    delay_steps = int(wp.floor(delay))
    # The moment of a sample lies within the first of its sub-steps, behind this share of it.
    share = one - (delay - wp.float64(delay_steps))
    band_out = wp.max(numbers[c, Place.BAND_OUT], zero)
    band_in = wp.max(numbers[c, Place.BAND_IN], zero)
    per_stroke_out = one / (one - band_out)
    per_stroke_in = one / (one - band_in)
    per_speed = wp.float64(2.0) / (numbers[c, Place.SPEED_OUT] + numbers[c, Place.SPEED_IN])
    late = _approach(step_s, numbers[c, Place.SPEED_LAG_S])
    pumping = _approach(step_s, numbers[c, Place.PUMP_LAG_S])
    play = wp.max(numbers[c, Place.PLAY], zero)
    # One step of the ringing, exact for a speed that is constant over it; without ringing all at once.
    omega = one
    damped = zero
    cosine = zero
    sine = zero
    if numbers[c, Place.RINGING_S] > zero:
        omega = wp.float64(2.0 * wp.pi) / numbers[c, Place.RINGING_S]
        damped = numbers[c, Place.DAMPING] * omega
        swing = omega * wp.sqrt(one - numbers[c, Place.DAMPING] * numbers[c, Place.DAMPING])
        fade = wp.exp(-damped * step_s)
        cosine = fade * wp.cos(swing * step_s)
        sine = fade * wp.sin(swing * step_s) / swing
    sag = numbers[c, Place.WEIGHT_RAD_S2] / (omega * omega)
    slow = zero
    ring = zero
    ring_rate = zero
    driven = zero
    out = zero
    pump = zero
    x_before = zero
    moving = wp.int32(0)
    building = _approach(step_s, numbers[c, Place.BUILDING_S])
    pressure = zero
    is_free = wp.int32(0)
    begin = wp.int32(-1)
    for k in range(load.shape[0]):
        if begins[k] != begin:
            begin = begins[k]
            slow = zero
            ring = zero
            ring_rate = zero
            driven = zero
            out = zero
            pump = zero
            x_before = zero
            moving = wp.int32(0)
            pressure = zero
            is_free = wp.int32(0)
        asked = zero
        by_pose = one
        load_out = one
        load_in = one
        for i in range(NUM_POSE):
            by_pose += numbers[c, Place.POSE_1 + i] * poses[k, i]
        for i in range(NUM_LOAD):
            load_out += numbers[c, Place.LOAD_OUT_1 + i] * loads[k, i]
            load_in += numbers[c, Place.LOAD_IN_1 + i] * loads[k, i]
        for i in range(NUM_WAYS):
            load_out += numbers[c, Place.OTHERS_OUT_1 + i] * opened_others[k, i]
            load_in += numbers[c, Place.OTHERS_IN_1 + i] * opened_others[k, i]
        warm = one + numbers[c, Place.DRIFT] * (time_s[k] / DRIFT_SPAN_S - half)
        if numbers[c, Place.THERMAL_SHARE] != zero:
            fading = wp.exp(-time_s[k] / numbers[c, Place.THERMAL_S])
            if numbers[c, Place.THERMAL_GROWS] > zero:
                fading = one - fading
            warm *= one + numbers[c, Place.THERMAL_SHARE] * fading
        for i in range(substeps):
            x = zero
            at = k * substeps + i - delay_steps - 1
            if at >= begin * substeps:
                x = wp.float64(spool[which[c], at])
            if numbers[c, Place.STROKE] > zero:
                x = wp.clamp(x, -numbers[c, Place.STROKE], numbers[c, Place.STROKE])
            if numbers[c, Place.START_COMMAND] > zero:
                least = numbers[c, Place.START_COMMAND]
                if moving == 1:
                    least *= numbers[c, Place.STOP_RATIO]
                moving = wp.int32(0)
                if wp.abs(x) > least:
                    moving = wp.int32(1)
                else:
                    x = zero
            opened_out = per_stroke_out * _open(x_before, x, band_out)
            opened = per_stroke_in * _open(-x_before, -x, band_in)
            x_before = x
            speed = zero
            if opened_out > opened:
                opened = opened_out
                speed = numbers[c, Place.SPEED_OUT] * _shape_flow(
                    opened, numbers[c, Place.CURVE_OUT], numbers[c, Place.BEND_OUT]
                )
            else:
                speed = -numbers[c, Place.SPEED_IN] * _shape_flow(
                    opened, numbers[c, Place.CURVE_IN], numbers[c, Place.BEND_IN]
                )
            own = wp.abs(speed) * per_speed
            asked += speed * per_speed * step
            total = own + demand[k]
            cut = one
            if numbers[c, Place.PUMP_LOAD] * total > one:
                cut /= numbers[c, Place.PUMP_LOAD] * total
            if numbers[c, Place.DEMAND_LIMIT] > zero and total > numbers[c, Place.DEMAND_LIMIT]:
                cut *= numbers[c, Place.DEMAND_LIMIT] / total
            by_load = load_in
            helping = -load[k]
            if speed > zero:
                by_load = load_out
                helping = load[k]
            if numbers[c, Place.PUMP_LAG_S] > zero:
                needed = wp.max(-numbers[c, Place.PUMP_WEIGHT] * helping, zero)
                wanted = wp.min(own / wp.float64(WAKING_DEMAND), one) * (one + needed)
                pump += pumping * (wp.max(wanted, pressing[k]) - pump)
                cut *= wp.clamp((pump - needed) / wp.float64(FULL_MARGIN), zero, one)
            speed *= by_pose * by_load * warm * cut
            alone = one
            if numbers[c, Place.LOAD_ALONE] > zero:
                alone = one / (one + numbers[c, Place.LOAD_ALONE] * demand[k])
            speed *= one - alone * numbers[c, Place.LOAD_OPPOSING] * wp.max(-helping, zero)
            speed *= wp.max(one + alone * numbers[c, Place.LOAD_BOTH] * helping, zero)
            if numbers[c, Place.LOAD_ROOT] != zero:
                share = numbers[c, Place.LOAD_CONSTANT]
                pressure = wp.max(share - (one - share) * helping, zero)
                speed *= wp.sqrt(
                    wp.max(one - alone * numbers[c, Place.LOAD_ROOT] * pressure, wp.float64(0.01))
                )
            if numbers[c, Place.TOP_SHARE] > zero:
                speed = wp.clamp(
                    speed,
                    -numbers[c, Place.TOP_SHARE] * numbers[c, Place.SPEED_IN],
                    numbers[c, Place.TOP_SHARE] * numbers[c, Place.SPEED_OUT],
                )
            slow += late * (speed - slow)
            speed = slow
            if opened <= zero:
                speed += numbers[c, Place.CREEP] + numbers[c, Place.CREEP_BY_LOAD] * load[k]
            if sag != zero and k > begin:
                speed += sag * (load[k] - load[k - 1]) / period_s
            off = ring - speed
            ring = speed + (cosine + damped * sine) * off + sine * ring_rate
            ring_rate = (cosine - damped * sine) * ring_rate - omega * omega * sine * off
            speed = ring
            if stops[k] > 0 and speed > zero:
                speed = zero
            if stops[k] < 0 and speed < zero:
                speed = zero
            if numbers[c, Place.BREAKAWAY] > zero:
                least = numbers[c, Place.BREAKAWAY] / per_speed
                if opened <= zero:
                    pressure = zero
                    is_free = wp.int32(0)
                pressure += building * (speed - pressure)
                if wp.abs(pressure) > least:
                    is_free = wp.int32(1)
                lost = least * wp.float64(RUNNING_SHARE)
                speed -= wp.clamp(speed, -lost, lost)
                if is_free == 0:
                    speed = zero
            driven += step_s * speed
            out_before = out
            out = wp.clamp(out, driven - half * play, driven + half * play)
            if i == 0:
                path[c, k] = wp.float32(out_before + share * (out - out_before))
        flow[c, k] = wp.float32(asked)


@wp.kernel(enable_backward=False)
def simulate_servo(
    spool: wp.array2d[wp.float32],
    which: wp.array[wp.int32],
    begins: wp.array[wp.int32],
    load: wp.array[wp.float64],
    position: wp.array[wp.float64],
    middle: wp.float64,
    period_s: wp.float64,
    substeps: int,
    numbers: wp.array2d[wp.float64],
    path: wp.array2d[wp.float32],
):
    """Follow the target `which` of each candidate from the recorded `position` on, `(C, T)`."""
    c = wp.tid()
    one = wp.float64(1.0)
    zero = wp.float64(0.0)
    step_s = period_s / wp.float64(substeps)
    source = which[c]
    delay = numbers[c, ServoPlace.DELAY_S] / step_s
    delay_steps = int(wp.floor(delay))
    share = one - (delay - wp.float64(delay_steps))
    w = one / numbers[c, ServoPlace.RESPONSE_S]
    damping = numbers[c, ServoPlace.DAMPING_RATIO]
    inside = numbers[c, ServoPlace.FIRMWARE_DAMPING]
    brake_s = wp.float64(2.0) * inside * damping / w
    push = step_s * w * w
    fade = step_s * wp.float64(2.0) * damping * w
    outside_fade = fade * (one - inside)
    # An error of 5 % of the travel is a tenth of half of it.
    limit = wp.float64(0.1) / wp.max(numbers[c, ServoPlace.SHORTAGE], wp.float64(1e-3))
    lead = numbers[c, ServoPlace.LEAD_S] / step_s
    q = zero
    speed = zero
    wound = zero
    begin = wp.int32(-1)
    before = zero
    for k in range(position.shape[0]):
        if begins[k] != begin:
            begin = begins[k]
            q = position[k] - middle
            speed = zero
            wound = zero
            before = wp.float64(spool[source, k * substeps])
        sag_there = numbers[c, ServoPlace.SAG] - numbers[c, ServoPlace.SAG_LOAD] * load[k]
        dry = numbers[c, ServoPlace.DRY]
        for i in range(substeps):
            at = wp.max(k * substeps + i - delay_steps - 1, begin * substeps)
            target = wp.float64(spool[source, at])
            # Polynomials of the simulated place, as in `side.describe_poses`: the measured one would tell the joint
            # how it moves.
            x = wp.clamp(q, -wp.float64(2.0), wp.float64(2.0))
            square = x * x
            sag = sag_there + numbers[c, ServoPlace.SAG_POSE_1] * x
            sag += numbers[c, ServoPlace.SAG_POSE_2] * (square - wp.float64(1.0 / 3.0))
            sag += numbers[c, ServoPlace.SAG_POSE_3] * (square - wp.float64(0.6)) * x
            sag += numbers[c, ServoPlace.SAG_POSE_4] * (
                square * (square - wp.float64(6.0 / 7.0)) + wp.float64(3.0 / 35.0)
            )
            held = target + lead * (target - before)
            before = target
            if numbers[c, ServoPlace.WOUND] > zero:
                most = numbers[c, ServoPlace.WOUND]
                wound += step_s / numbers[c, ServoPlace.WIND_S] * (target - q)
                wound = wp.clamp(wound, -most, most)
                held += wound
            after = (speed + push * (held - q - sag)) / (one + fade)
            pull = held - q - brake_s * after
            if pull > limit:
                pull = limit
                after = (speed + push * (limit - sag)) / (one + outside_fade)
            elif pull < -limit:
                pull = -limit
                after = (speed - push * (limit + sag)) / (one + outside_fade)
            friction = dry + numbers[c, ServoPlace.LOAD_DRY] * wp.abs(pull)
            if speed == zero:
                friction *= one + numbers[c, ServoPlace.STATIC_RATIO]
            lost = push * friction / (one + outside_fade)
            if after > lost:
                after -= lost
            elif after < -lost:
                after += lost
            else:
                after = zero
            speed = after
            if i == 0:
                path[c, k] = wp.float32(q + share * step_s * speed + middle)
            q += step_s * speed
