"""Synthetic boreholes: an analytic ray tracer and random scenes, in numpy and OpenCV, without OpenGL.

Geometry and light: `solids`, `drilled_block`, `ray_tracer`. Pictures of light: `stereo_camera`.
Random scenes: `scene_ranges`, `scene_sampler`. `frame_renderer` makes frames of them.

It is the oracle of perception: depth, masks and the rim are exact, and both pictures of a stereo
pair show the same texture at the same points of space.
"""
