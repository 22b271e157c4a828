"""Effects: imperfections that a simulator leaves out, each a small spec around an actuator model.

    side          acts on                                             names
    command       `history.u` as the inner model sees it               dead_time delay_jitter
    frame_loss clock_offset
                                                                       dead_band saturation
                                                                       rate_limit stiction
    speed         the increment that the inner model returns           flow_gain asymmetry lag
    backlash compliance thermal_drift
                                                                       load_dependence creep
    joints        the increments of all joints together                flow_sharing
    measurement   the position that controller and recording see       quantisation sensor_noise
    encoder_bias encoder_scale kinematics    where tool and borehole are, against the model
    link_length base_tilt extrinsics

Order: the first effect of a list is nearest to the machine. A command passes from the last effect
to the first, motion and
measurement from the first to the last: `effect=[encoder_bias,quantisation]` rounds the biased
angle, and `effect=[dead_band,saturation]` cuts the command before the valve's dead band sees it.

The formula of an effect is a pure function of parameters, memory and the present moment;
`actuators.effects.effect` does the rest: parameters per environment, memory in place, reset,
randomness from a counter in the state.
"""
