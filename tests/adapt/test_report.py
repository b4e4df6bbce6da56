"""What is printed of the choice of a residual."""

import pytest

from adapt.report import residual_line


@pytest.mark.parametrize(
    ("residual", "line"),
    [
        ({"kind": "linear"}, "residual: linear"),
        ({"kind": "parameters", "tried": {"parameters": 1e-4}}, "residual: parameters, which leaves next to nothing"),
        (
            {"kind": "linear", "tried": {"parameters": "too few", "linear": 1.0, "state": 1.62}},
            "residual: linear; error of held-out flight, relative: parameters can't be fitted, linear 1.00, state 1.62",
        ),
    ],
)
def test_the_kind_is_told_with_what_was_tried(residual, line):
    assert residual_line(residual) == line
