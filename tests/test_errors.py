import pytest

from torchrl_bayessim.errors import PhysicsError, message


def test_message_lists_near_names_first_and_caps_the_rest():
    text = message(
        "a joint name", "hinge_l", available=[f"joint{i}" for i in range(40)] + ["hinge_1"]
    )
    assert text.index("hinge_1 (did you mean this?)") < text.index("joint0")
    assert "and 21 more" in text


def test_message_is_what_the_exception_shows():
    with pytest.raises(PhysicsError, match=r"expected a name, got 'x'\. Try: y\."):
        raise PhysicsError(message("a name", "x", hint="y"))


def test_names_from_files_do_not_reach_the_terminal_as_they_are():
    text = message("a column", "q", available=["\033[2Jq1", "\u202eq2", "täglich"])
    assert "\\x1b[2Jq1" in text
    assert "\\u202eq2" in text
    assert "täglich" in text
    assert text.isprintable()
