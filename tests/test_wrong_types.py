"""Every public function answers a value of the wrong kind with an error of ours: one sentence, never a foreign exception."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import tau_dyn as td
from tau_dyn import by_measurement

T = np.arange(0.0, 4.0, 0.01)
WRONG = {
    "int": 5,
    "None": None,
    "list": ["a", 1],
    "table": pd.DataFrame({"a": [1.0, 2.0]}),
    "empty": "",
    "folder": Path(__file__).parent,
    "object": object(),
}
"""Values of the wrong kind; None and the empty list are right in some places."""


def log() -> td.Log:
    return td.Log(T, {"q_axis": 0.1 * np.sin(5 * T), "tau_axis": 20 * np.cos(5 * T)})


CALLS: dict[str, Callable[[Any], Any]] = {
    "load_robot": td.load_robot,
    "load_robot actuated": lambda x: td.load_robot("linear_axis", actuated=x),
    "load_robot tool": lambda x: td.load_robot("linear_axis", tool=x),
    "load_robot packages": lambda x: td.load_robot("linear_axis", packages=x),
    "load_robot srdf": lambda x: td.load_robot("linear_axis", srdf=x),
    "load_robot hold": lambda x: td.load_robot("linear_axis", hold=x),
    "load_robot contacts": lambda x: td.load_robot("linear_axis", contacts=x),
    "read_log": td.read_log,
    "read_log columns": lambda x: td.read_log("absent.csv", x),
    "Log t": lambda x: td.Log(x, {}),
    "Log channels": lambda x: td.Log(T, x),
    "Log column": lambda x: td.Log(T, {"q_axis": x}),
    "Log index": lambda x: log()[x],
    "check_log": td.check_log,
    "check_log robot": lambda x: td.check_log(log(), x),
    "identify robot": lambda x: td.identify(x, log()),
    "identify logs": lambda x: td.identify("linear_axis", x),
    "identify controller": lambda x: td.identify("linear_axis", log(), controller=x),
    "identify holdout": lambda x: td.identify("linear_axis", log(), holdout=5 if x is None else x),
    "identify model": lambda x: td.identify("linear_axis", log(), model=x),
    "identify choices": lambda x: td.identify("linear_axis", log(), choices=5 if x is None else x),
    "identify preparation": lambda x: td.identify("linear_axis", log(), preparation=5 if x is None else x),
    "identify exclude": lambda x: td.identify("linear_axis", log(), exclude=x),
    "identify per_log": lambda x: td.identify("linear_axis", log(), per_log=x),
    "identify estimator": lambda x: td.identify("linear_axis", log(), estimator=x),
    "identify seed": lambda x: td.identify("linear_axis", log(), seed=str(x)),
    "identify progress": lambda x: td.identify("linear_axis", log(), progress=x),
    "diagnose model": lambda x: td.diagnose("linear_axis", log(), model=x),
    "diagnose robot": lambda x: td.diagnose(x, log()),
    "diagnose logs": lambda x: td.diagnose("linear_axis", x),
    "calibrate robot": lambda x: td.calibrate(x, "absent.csv"),
    "calibrate poses": lambda x: td.calibrate("linear_axis", x),
    "find_modes logs": lambda x: td.find_modes(x, ["tau_axis"], ["q_axis"]),
    "find_modes inputs": lambda x: td.find_modes(log(), x, ["q_axis"]),
    "compare_fit model": lambda x: td.compare_fit(x, log()),
    "compare_fit logs": lambda x: td.compare_fit(td.Model.of(td.load_robot("linear_axis")), x),
    "Model.load": td.Model.load,
    "Model.of": td.Model.of,
    "Model.of effects": lambda x: td.Model.of(td.load_robot("linear_axis"), x),
    "Model.with_values": lambda x: td.Model.of(td.load_robot("linear_axis")).with_values(x),
    "Feedforward": td.Feedforward,
    "Feedforward.load": td.Feedforward.load,
    "Feedforward width": lambda x: td.Feedforward(td.Model.of(td.load_robot("linear_axis")), width=x),
    "build_mechanism": td.build_mechanism,
    "forward_kinematics": lambda x: td.forward_kinematics(x, np.zeros(1)),
    "forward_kinematics q": lambda x: td.forward_kinematics("linear_axis", x),
    "inverse_kinematics": lambda x: td.inverse_kinematics(x, np.zeros(3)),
    "inverse_kinematics poses": lambda x: td.inverse_kinematics("linear_axis", x),
    "simulate model": lambda x: td.simulate(x, None),
    "simulate motion": lambda x: td.simulate(td.Model.of(td.load_robot("linear_axis")), x),
    "fetch_data": td.fetch_data,
    "write_report path": lambda x: td.write_report(x, td.load_robot("linear_axis")),
    "write_report result": lambda x: td.write_report("page.html", x),
}


@pytest.mark.parametrize("call", CALLS)
def test_a_wrong_kind_is_an_error_of_ours(call, tmp_path, monkeypatch):
    """A number, None, a list, a table without columns, no text, a folder: answered, or refused with a code."""
    monkeypatch.chdir(tmp_path)
    foreign = {}
    for kind, value in WRONG.items():
        try:
            CALLS[call](value)
        except td.TauDynError as fault:
            assert fault.code and str(fault)
        except Exception as fault:
            foreign[kind] = repr(fault)
    assert not foreign
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("function", "options"), [(td.identify, "IdentifyOptions"), (td.diagnose, "ForceOptions")])
def test_help_names_each_option(function: Callable[..., Any], options: str) -> None:
    """`help` shows the signature `**options`; its text names the options that type checkers know, and no object's address."""
    text = inspect.getdoc(function) or ""
    listed = re.split(r", as\s+`", text.partition("**options: ")[2])[0]
    known = inspect.get_annotations(by_measurement.ForceOptions) | inspect.get_annotations(
        getattr(by_measurement, options)
    )
    assert set(re.findall(r"`(\w+)`", listed)) == set(known)
    assert " at 0x" not in str(inspect.signature(function))
