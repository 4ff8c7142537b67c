"""Characteristics given as points: straight lines between them, the ends held beyond. Tables of values are such curves too."""

from hilrunner.base.compiled import hot


@hot
def interpolate(x_points, y_points, first, count, x):
    """Value at x of the curve whose points are first … first + count - 1; x is a number, x_points increase.

    A point's own x gives its y to the last bit where the y are whole numbers, as in tables of values.
    """
    if not x > x_points[first]:
        return y_points[first]
    for right in range(first + 1, first + count):
        if x <= x_points[right]:
            left = right - 1
            part = (x - x_points[left]) / (x_points[right] - x_points[left])
            return y_points[left] + (y_points[right] - y_points[left]) * part
    return y_points[first + count - 1]
