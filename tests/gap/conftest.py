"""What holds in all diagnoses: their threads take turns at CasADi's symbols."""

import threading

import casadi as ca
import pytest

from trms_cli.core.threads import SYMBOLS


@pytest.fixture(autouse=True)
def _symbols_in_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Building symbols in a thread out of turn fails; left alone, it rarely ends the process."""

    def in_turn(owner: object, name: str) -> None:
        original = getattr(owner, name)

        def checked(*arguments, **options):
            in_thread = threading.current_thread() is not threading.main_thread()
            assert SYMBOLS.is_mine or not in_thread, f"{name} out of turn"
            return original(*arguments, **options)

        monkeypatch.setattr(owner, name, checked)

    for name in ("jacobian", "cse", "densify", "vertcat", "substitute"):
        in_turn(ca, name)
    in_turn(ca.Function, "__init__")
    in_turn(ca.CodeGenerator, "__init__")
