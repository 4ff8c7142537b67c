"""The classical Runge-Kutta method of order four for right-hand sides that take and return tuples.

nodes 0, 1/2, 1/2, 1; each stage starts from the one before; weights 1/6, 1/3, 1/3, 1/6 (Kutta 1901).
"""

from hilrunner.base.compiled import hot, inlined

# |R(z)| <= 1 for RK4 on the negative real axis up to 2.785 and on the imaginary axis up to 2.828
REAL_AXIS_LIMIT = 2.785293563405282
_NODE = (0.0, 0.5, 0.5, 1.0)
_WEIGHT = (1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0)


@hot
def _shifted_4(y, h, k):
    return (y[0] + h * k[0], y[1] + h * k[1], y[2] + h * k[2], y[3] + h * k[3])


@hot
def _shifted_5(y, h, k):
    return (y[0] + h * k[0], y[1] + h * k[1], y[2] + h * k[2], y[3] + h * k[3], y[4] + h * k[4])


@hot
def _shifted_6(y, h, k):
    return (
        y[0] + h * k[0],
        y[1] + h * k[1],
        y[2] + h * k[2],
        y[3] + h * k[3],
        y[4] + h * k[4],
        y[5] + h * k[5],
    )


@hot
def _shifted_8(y, h, k):
    return (
        y[0] + h * k[0],
        y[1] + h * k[1],
        y[2] + h * k[2],
        y[3] + h * k[3],
        y[4] + h * k[4],
        y[5] + h * k[5],
        y[6] + h * k[6],
        y[7] + h * k[7],
    )


@hot
def _shifted_10(y, h, k):
    return (
        y[0] + h * k[0],
        y[1] + h * k[1],
        y[2] + h * k[2],
        y[3] + h * k[3],
        y[4] + h * k[4],
        y[5] + h * k[5],
        y[6] + h * k[6],
        y[7] + h * k[7],
        y[8] + h * k[8],
        y[9] + h * k[9],
    )


_SHIFTED = {4: _shifted_4, 5: _shifted_5, 6: _shifted_6, 8: _shifted_8, 10: _shifted_10}


@inlined
def _as_it_is(context, y):
    return y


def make_rk4(rates, state_count: int, settled=_as_it_is):
    """An integrator over `count` equal steps with everything else held.

    Args:
        rates: hot (context, y, lines) -> (dy/dt, lines), y a tuple of `state_count` floats; `lines` is carried from
            stage to stage (a solver's starting guess) and takes no part in the method.
        state_count: 4, 5, 6, 8 or 10.
        settled: hot (context, y) -> y, what a finished step's states become: the bounds that a step of finite length may overshoot.

    Returns:
        hot (context, y, lines, step_s, count) -> (y, lines).
    """
    shifted = _SHIFTED[state_count]

    @hot
    def integrate(context, y, lines, step_s, count):
        for _ in range(count):
            following = y
            k = y
            # one call of the rates in the code: a quarter of the machine code to compile and to keep in the cache
            for stage in range(4):
                at = y if stage == 0 else shifted(y, _NODE[stage] * step_s, k)
                k, lines = rates(context, at, lines)
                following = shifted(following, _WEIGHT[stage] * step_s, k)
            y = settled(context, following)
        return y, lines

    return integrate
