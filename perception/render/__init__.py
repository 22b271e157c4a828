"""Boreholes that were never drilled: an analytic renderer, and scenes for it; numpy and OpenCV only, no GL library.

`solids`, `drilled`, `texture`, `tracer`, `sensor` draw what there is; `scenes` (ranges), `drawing`,
`concrete`, `arm` say what there is; `rig` is the camera pair, `studio` makes frames of it all.

It is the oracle of perception: depth, masks and the rim are those of the mathematics, and both
pictures of a stereo pair show the same texture at the same points of space.
"""
