"""Plants of an exam, written apart from the library's models; some share the textbook equation.

changes            table of effects as changes of numbers
family             runs, a link to them, and a family of plants that draws them from seeds
electronics        command frames on the bus, losses in bursts, encoders
linkage            weight of an arm, tool point
valve_faults       effects as changes of numbers, on machines with valves; causes outside the library
valve_arm          bus, oil, stops, play and encoders around any hydraulics; the family with a load-sensing pump
hydraulics         its pilot pressure, spool, notches, compensators, pump, cylinders on a linkage
circuits           the family on the three circuits of `actuators.models.circuit`
servo_…            the same for tabletop arms of position servos in MuJoCo C

The plants share no code with `actuators.effects` or any fitted model, so that a right answer does not
rest on an identical implementation. Axes: `N` runs, `J` joints.

Sources of the hydraulics:
Merritt, Hydraulic Control Systems (1967): orifices and leakage (ch. 3), flow forces and spools
(ch. 5), chambers and valve-controlled actuators (ch. 6).
Jelali and Kroll, Hydraulic Servo-systems (2003): cylinders, friction, load-sensing supply (ch. 2
to 4).
Armstrong-Helouvry, Dupont and Canudas de Wit, Automatica 30 (1994) 1083: static friction.
Gilbert, Bell System Technical Journal 39 (1960) 1253: losses in bursts.
Figures of the ranges are chosen by hand for arms of about a tonne.
"""
