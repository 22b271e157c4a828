"""An analytic renderer of boreholes: exact rays on planes, boxes and cylinders; numpy and OpenCV only, no GL library.

It is the oracle of perception: depth, masks and the rim are those of the mathematics, and both pictures of a stereo pair show the
same texture at the same points of space.
"""
