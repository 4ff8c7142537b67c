"""The state of one axis: one flat float64 array, the same places for every circuit and engine.

| place | meaning | paper | lift | lift-lines | mass-free / surrogate |
| --- | --- | --- | --- | --- | --- |
| 0 | rod position, m | state | state | state | state |
| 1 | rod velocity, m/s | state | state | state | state |
| 2 | chamber 1 (bore side) pressure, Pa gauge | state | state | state | state |
| 3 | chamber 2 (rod side) pressure, Pa gauge | state | state | state | state |
| 4 | spool 1 (bore-side counterbalance valve) position, m | 0 | state | state | state |
| 5 | spool 2 (rod-side counterbalance valve) position, m | state | state | state | state |
| 6 | spool 1 velocity, m/s | 0 | state | state | derived |
| 7 | spool 2 velocity, m/s | state | state | state | derived |
| 8 | line a (bore side) pressure, Pa | p_s side, derived | algebraic, warm start | state | derived |
| 9 | line b (rod side) pressure, Pa | p_r, derived | algebraic, warm start | state | derived |
"""

ROD_POSITION = 0
ROD_VELOCITY = 1
CHAMBER_1_PRESSURE = 2
CHAMBER_2_PRESSURE = 3
SPOOL_1_POSITION = 4
SPOOL_2_POSITION = 5
SPOOL_1_VELOCITY = 6
SPOOL_2_VELOCITY = 7
LINE_A_PRESSURE = 8
LINE_B_PRESSURE = 9
STATE_SIZE = 10
