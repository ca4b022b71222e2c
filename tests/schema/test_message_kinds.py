"""Messages with a kind."""

from __future__ import annotations

import copy
import json
import pickle

from mauvecl.schema.messages import Message, of_kind


def test_messages_are_sentences_that_keep_their_kind() -> None:
    message = Message("SATURATED: 3 pixels.", "saturated")
    assert message == "SATURATED: 3 pixels."
    assert json.loads(json.dumps([message])) == [str(message)]
    for same in (pickle.loads(pickle.dumps(message)), copy.deepcopy(message)):
        assert (same, same.kind) == (message, "saturated")


def test_messages_are_selected_by_kind() -> None:
    messages = ["plain", Message("one", "a"), Message("two", "b"), Message("three", "a")]
    assert of_kind(messages, "a") == ["one", "three"]
    assert of_kind(messages, "") == []
