"""The list of checks."""

from pickplace import Failure
from pickplace.rules.checks import CHECKS


def test_every_failure_of_an_action_has_its_place_in_the_order():
    """The codes are in the order of the checks, but for the last ones, which came later."""
    order, later = (
        list(dict.fromkeys(failure for failure, _, _ in CHECKS)),
        [Failure.OUT_OF_REACH, Failure.FORBIDDEN_TURN, Failure.OVERLOADED],
    )
    assert order == [*sorted(set(order) - {*later}), *later]
    assert set(order) == set(Failure) - {Failure.NONE, Failure.STUCK}
