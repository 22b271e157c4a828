"""Plants of an exam, written apart from the library's models; some share the textbook equation.

plant_parameters         parameters of one machine, drawn from a seed, nuisances included
electronics              command frames on the bus; encoders and tracker
valve                    pilot, spool, metering land
power_stages             from opening to speed, three makes
linkage                  elastic boom, play, weight, tool
changes                  table of effects as changes of numbers
family                   bases of a link to runs, and of a family of plants
faults                   effects of the library as changes of the parameters
out_of_library_faults    faults that the library has no name for
plant                    all parts at work in N runs side by side

Numpy only. The plants share no code with `actuators.effects`, `actuators.models.hydraulic` or any
fitted model, so that a right answer does not rest on an identical implementation. Axes: `N` runs,
`J` joints.
"""
