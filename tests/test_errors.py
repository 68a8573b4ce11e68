"""An error names what its reader can change: options on the command line, arguments in Python."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

import ncs_jax
from ncs_jax.cli import main
from ncs_jax.cli.parser import _show_warning
from ncs_jax.errors import InputError, InputWarning, check_alpha, for_python


@pytest.mark.parametrize(
    ("command", "python"),
    [
        ("add --resume, or choose another --out", "add resume=True, or choose another out"),
        ("begin from its weights: --from runs/a", "begin from its weights: start runs/a"),
        ("as --scale 0.01 --up=-z --move 0 1 0, or --stay", "as scale 0.01 up=-z move 0 1 0, or move=(0, 0, 0)"),
        ("`ncs train --resume` goes on; see --body-up", "`ncs train --resume` goes on; see body_up"),
        ("my--dress.obj, -- and a--b", "my--dress.obj, -- and a--b"),
    ],
)
def test_options_become_arguments(command, python):
    assert for_python(command) == python
    error = InputError(command, field="--rank", mend=command)
    assert str(error) == f"rank: {python}; {python}" and error.as_command == f"--rank: {command}; {command}"


def test_warnings_too(capsys):
    with pytest.warns(InputWarning, match="^begin anew: start a$"):
        warnings.warn("begin anew: --from a", InputWarning, stacklevel=1)
    _show_warning(InputWarning("begin anew: --from a"), InputWarning, "", 0)
    assert capsys.readouterr().err == "ncs: warning: begin anew: --from a\n"


def test_the_same_mistake_in_python_and_on_the_command_line(tmp_path, capsys):
    (tmp_path / "run.json").write_text("{}")
    with pytest.raises(InputError, match=r"add resume=True, or choose another out$"):
        ncs_jax.train("ncs:tshirt", tmp_path)
    assert main(["train", "ncs:tshirt", "--out", str(tmp_path)]) == 2
    assert capsys.readouterr().err.endswith("add --resume, or choose another --out\n")


@pytest.mark.parametrize("alpha", [-0.1, 10.5, float("nan"), float("inf")])
def test_alpha_from_0_to_10_is_meant(alpha):
    with pytest.raises(InputError, match=r"^alpha: a number from 0 to 10 expected \(found .*\); 0 is static, 1 as trained"):
        check_alpha(alpha)
    check_alpha(0)
    check_alpha(np.float32(10.0))
