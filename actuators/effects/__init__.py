"""Effects: imperfections that a simulator leaves out, each a small spec around an actuator model.

An effect acts at one place, its `side`:

    side         acts on
    command      `history.u`, before the inner model gets it      dead_band, dead_time, …
    speed        the increment that the inner model returns       lag, backlash, creep, …
    joints       the increments of all joints together            flow_sharing
    measurement  the position that controller and recording get   quantisation, encoder_bias, …
    kinematics   tool and borehole, compared with the model       link_length, base_tilt, extrinsics

Order: the first effect of a list is nearest to the machine. A command passes from the last effect
to the first, motion and measurement from the first to the last. So
`effect=[encoder_bias,quantisation]` rounds the biased angle, and `effect=[dead_band,saturation]`
cuts the command before it reaches the valve's dead band.

The formula of an effect is a pure function of its parameters, its memory and the present history.
`actuators.effects.effect` does the rest: parameters per environment, memory in place, reset, and
random numbers from a counter in the state.
"""
