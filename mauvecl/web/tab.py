"""Base class of tabs: charts, simulations and tables for download."""

from __future__ import annotations

from abc import ABC
from collections.abc import Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

from mauvecl.answers.verbs import VERBS
from mauvecl.schema.columns import View, without_empty
from mauvecl.web.closed_forms import Answers
from mauvecl.web.fields import FIELDS, star_words
from mauvecl.web.question import verbs_of

if TYPE_CHECKING:
    from astropy.table import Table

    from mauvecl.charts.chart import Chart
    from mauvecl.study.study import Study
    from mauvecl.web.closed_forms import ClosedForms
    from mauvecl.web.question import Question

#: Columns that the page does not show: its question has one star and one flare.
FIXED = ("star", "amplitude")


def target_words(question: Question) -> str:
    """Return the targets and days of a question in words."""
    names = ", ".join(target["name"] for target in question.targets) or "no target yet"
    return f"{names}; {question.days:g} days from {question.start}"


class Tab(ABC):
    """Tab of the page; a `verb` gives name, title, help, button, answer and file that the tab does not state itself."""

    verb: ClassVar[str] = ""  # name of the verb that it shows, if any
    name: ClassVar[str]
    title: ClassVar[str]
    about: ClassVar[str]  # what it shows, in a sentence
    pictures: ClassVar[tuple[Chart, ...]] = ()
    simulations: ClassVar[Mapping[str, str]] = {}  # what can be simulated here, with the label of the button
    answer: ClassVar[str] = ""  # name of the simulated answer whose table is below the pictures
    view: ClassVar[int] = 0  # number of that table among the answer's `views`
    #: Questions of "Share, export, cite": names of simulations or verbs; by default its own simulations.
    questions: ClassVar[tuple[str, ...]] = ()
    #: Key of `GROUPS` under whose heading it stands; by default that of the verb that answers its first question.
    group: ClassVar[str]
    #: Whether the chance of detection stands above it, whose fields it then shows.
    chance: ClassVar[bool] = True
    #: Fields that it reads although its verbs do not take their keys, and those that it does not read.
    also: ClassVar[tuple[str, ...]] = ()
    never: ClassVar[tuple[str, ...]] = ()
    #: Tables that can be downloaded, with the simulation that each needs, or none.
    files: ClassVar[Mapping[str, str | None]] = {}
    #: Documents of answers that can be downloaded, by file name, with the simulation that each needs.
    documents: ClassVar[Mapping[str, str]] = {}

    def __init_subclass__(cls, **words: Any) -> None:
        super().__init_subclass__(**words)
        if cls.verb:
            cls._follow_verb()
        if "questions" not in vars(cls):
            cls.questions = tuple(cls.simulations) or ("detection",)
        if "group" not in vars(cls):
            cls.group = VERBS[verbs_of(cls.questions[0])[0]].group

    @classmethod
    def _follow_verb(cls) -> None:
        """Set the attributes that the tab does not define from its verb."""
        verb, title = cls.verb, cls.verb.capitalize()
        about, *_ = VERBS[verb].help.split("\n")
        of_verb = {"name": verb, "title": title, "about": about, "simulations": {verb: title}, "answer": verb}
        for key, value in (of_verb | {"files": {verb: verb}}).items():
            if key not in vars(cls):
                setattr(cls, key, value)

    @cached_property
    def reads(self) -> frozenset[str]:
        """Fields on which the tab depends, with those of the card: the chance, and the limit in a sentence."""
        above = ("detection", "limit") if self.chance else ()
        return self.reads_of(*self.questions, *self.simulations, *above)

    def reads_of(self, *questions: str) -> frozenset[str]:
        """Return the fields on which simulations or verbs depend, by the keys that the flags of their verbs set."""
        verbs = [VERBS[verb] for question in questions for verb in verbs_of(question)]
        taken = {
            name for name, field in FIELDS.items() if any(verb.accepts(key) for verb in verbs for key in field.keys)
        }
        return frozenset(taken | set(self.also)) - set(self.never)

    def given(self, question: Question) -> dict[str, Any]:
        """Read the visitor's files, and return them as arguments of the verb: by default none.

        Raises InputError with the name of the field whose file cannot be read. Called on a thread of its own.
        """
        return {}

    def words(self, question: Question) -> str:
        """Return the question of a tab without the chance, in words."""
        star = "your own star" if question.uploaded is not None else star_words(question.star)
        return f"{star} of {question.band} = {question.magnitude:g}"

    def offers(self, name: str, answers: Answers) -> bool:
        """Return whether one of `files` can be downloaded; by default, whether the answer it needs is simulated."""
        needed = self.files[name]
        return needed is None or needed in answers

    def table(self, name: str, closed: ClosedForms, answers: Answers) -> Table:
        """Return the table of one of `files`: by default that of the answer it needs."""
        table: Table = answers[str(self.files[name])].tables[name]
        return table

    def rows(self, closed: ClosedForms, answers: Answers) -> list[list[str]]:
        """Return a small table as text with a header row; empty if there is nothing to report."""
        shown = self.shown(closed, answers)
        if shown is None:
            return []
        headings, cells = without_empty(*shown.texts(FIXED))
        return [headings, *cells]

    def shown(self, closed: ClosedForms, answers: Answers) -> View | None:
        """Return the table below the pictures: by default a view of the simulated answer, if there is one."""
        view: View | None = answers[self.answer].views[self.view] if self.answer in answers else None
        return view

    def study(self, name: str, closed: ClosedForms, answers: Answers) -> Study:
        """Return the study that reproduces one of `files`: by default that of the answer it needs."""
        needed = self.files[name]
        study: Study = closed.study if needed is None else answers[needed].study
        return study


class Compare(Tab):
    """Pinned scenarios and the history of runs."""

    name, title, group = "compare", "Compare", "tools"
    about = "Scenarios that you have pinned, side by side, and what you have simulated; this browser tab keeps them."
