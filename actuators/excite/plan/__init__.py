"""A plan: the segments that each run plays, and everything that lies between a plan and a motion.

    schedule    excitations share the time of a run            -> Plan
    runner      approach, rest, play, with guards              Plan, measured positions -> commands
    drive       the control loop over a link; a nominal machine for prediction
    account     what was played when, `plan.json`
    picture     `plan.png`: a picture before it is a motion

Numpy only (tool speeds alone need torch): it also runs on the machine's own computer.
Axes: `N` runs, `T` control periods, `J` joints.
"""
