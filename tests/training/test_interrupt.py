"""Training is given up as a whole: Ctrl-C, or one network that fails, ends the other at its next report."""

import threading
import time

import pytest

from hilrunner.training import train


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_the_others_end_when_one_cannot_go_on(monkeypatch, tmp_path, error):
    ended, begun = [], threading.Event()

    def train_problem(problem, _plan, _folder, _resume, report):
        if problem == "fails":
            begun.wait(10)
            raise error("no")
        try:
            for iteration in range(10_000):
                begun.set()
                time.sleep(0.001)
                report(problem, "iteration", iteration / 10_000)
        finally:
            ended.append(iteration)

    monkeypatch.setattr(train, "train_problem", train_problem)
    with pytest.raises(error, match="no"):
        train.train_recipe(("long", "fails", "never begun"), None, tmp_path, False, lambda *_: None)
    assert len(ended) == 1 and ended[0] < 9_999


def test_results_come_in_the_order_of_the_networks(monkeypatch, tmp_path):
    monkeypatch.setattr(train, "train_problem", lambda problem, *_: problem.upper())
    assert train.train_recipe(("a", "b", "c"), None, tmp_path, False, lambda *_: None) == ["A", "B", "C"]
