"""Documents on the screen: the same text as the standard library writes, sooner."""

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from trms_cli.core.printable import _json_text

_LEAVES = st.none() | st.booleans() | st.integers() | st.floats() | st.text(st.characters())
_DOCUMENTS = st.recursive(
    _LEAVES, lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner), max_leaves=20
)


@given(_DOCUMENTS)
def test_it_is_what_the_standard_library_writes(document: Any) -> None:
    assert _json_text(document, allow_nan=True) == json.dumps(
        document, indent=2, ensure_ascii=False
    )


def test_names_that_are_no_text_stay_and_what_is_no_number_is_refused() -> None:
    assert json.loads(_json_text({"path": "a\udc80"}, allow_nan=False)) == {"path": "a\udc80"}
    with pytest.raises(ValueError, match="not JSON compliant"):
        _json_text([float("nan")], allow_nan=False)
