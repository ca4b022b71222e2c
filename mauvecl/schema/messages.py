"""Messages of results and answers: sentences for readers that programs can tell apart."""

from __future__ import annotations

from collections.abc import Iterable


class Message(str):
    """A sentence with its kind."""

    __slots__ = ("kind",)
    kind: str  # what the sentence is about, such as "saturated" or "wrong sign"; programs compare it, not the sentence

    def __new__(cls, text: str, kind: str = "") -> Message:
        """Make a message from its sentence and its kind."""
        self = super().__new__(cls, text)
        self.kind = kind
        return self

    def __getnewargs__(self) -> tuple[str, str]:  # type: ignore[override]
        """Return the arguments of the constructor, for pickle."""
        return str(self), self.kind

    def about(self, what: str) -> Message:
        """Return the message with its subject in parentheses at its end."""
        return Message(f"{self[:-1]} ({what}).", self.kind)


def of_kind(messages: Iterable[str], kind: str) -> list[str]:
    """Return the messages of a kind."""
    return [one for one in messages if isinstance(one, Message) and one.kind == kind]
