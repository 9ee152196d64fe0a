"""What a log calls its types and members never runs: rosbags makes Python of a definition, names as they stand."""

from __future__ import annotations

import builtins

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.records import Schema

from vilp_data.errors import LogError
from vilp_data.sources.message_decoders import decoder_for

BAD_NAMES = [
    "a:\n    pass\nimport builtins\nbuiltins.ran = True\nclass b",
    "a(print('ran'))",
    "pkg/msg/X:\n    import builtins; builtins.ran = True\nclass Y",
    "pkg/msg/'+str(1)+'",
    "3ensor_msgs/msg/JointState",
    "class",
    "pkg//X",
    "",
]


def decoder(name: str, text: str, encoding: str = "ros2msg") -> object:
    return decoder_for("cdr", Schema(1, text.encode(), encoding, name), where="test")


@pytest.mark.parametrize("name", BAD_NAMES)
def test_a_name_that_is_no_name_is_refused_before_code_is_made_of_it(name: str) -> None:
    with pytest.raises(LogError):
        decoder(name, "int32 a")
    assert not hasattr(builtins, "ran")


@given(st.text(min_size=1, max_size=12))
def test_whatever_the_name_the_definition_is_taken_or_refused_in_words(name: str) -> None:
    try:
        decoder("pkg/msg/" + name, "int32 a")
    except LogError as error:
        assert str(error)


def test_names_that_robots_use_are_taken() -> None:
    text = "int32 class\nint32 X=3\nother_msgs/Part[] parts\n" + "=" * 80 + "\nMSG: other_msgs/Part\nfloat64 b_2"
    assert decoder("my_pkg/msg/Thing2D", text)
