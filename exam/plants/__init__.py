"""Plants of other making than the library's models, for blind exams: what ails a machine is put into its physics.

    line        frames on the bus: delay, jitter, loss                               line.py
    valve       pilot, spool, metering land                                          valve.py
    power       from opening to speed, one of several makes                          chambers.py,
    compensated.py, throttled.py linkage     elastic boom, play, weight, tool
    linkage.py sensors     zero, scale, noise, converter
    sensors.py anatomy     the numbers of one machine, drawn from a seed, nuisances included
    anatomy.py faults      effects of the library's names as changes of those numbers
    faults.py strangers   ailments that the library has no name for
    strangers.py plant       all of it at work in N runs side by side
    plant.py

Numpy only, and no equation is shared with `actuators.effects`, `actuators.models.hydraulic` or any model
that is fitted: a diagnosis that
is right here is not right because examiner and examinee made the same simplification. Axes: `N`
runs, `J` joints.
"""
