"""The held-out make of the exam: its equations, nuisances and outside causes occur nowhere else.

Only a sealed exam may draw from it. Nothing is developed or calibrated on it: see
`arm.HeldOutPlants`.

parameters   one machine, drawn from a seed; sizes of effects as changes of its parameters
hydraulics   pilot pressure, spool, notches, compensators, load-sensing pump, cylinders on a linkage
causes       causes outside the library, none of which another make has
readings     frames on the bus and encoders
arm          all parts at work in N runs side by side; the plant family

A machine of this make has cylinders with two chambers, pressure-compensated meter-in, regulated
meter-out, and one pump that senses the highest load and has a limit of flow and one of power.

Sources:
Merritt, Hydraulic Control Systems (1967): orifices and leakage (ch. 3), flow forces and spools
(ch. 5), chambers and valve-controlled actuators (ch. 6).
Jelali and Kroll, Hydraulic Servo-systems (2003): cylinders, friction, load-sensing supply (ch. 2
to 4).
Armstrong-Helouvry, Dupont and Canudas de Wit, Automatica 30 (1994) 1083: static friction.
Gilbert, Bell System Technical Journal 39 (1960) 1253: losses in bursts.
Figures of the ranges are chosen by hand for arms of about a tonne.
"""
