"""Visitors of the page: their connection, jobs and answers."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import ctypes
import gc
import hashlib
import json
import logging
import math
import tempfile
import threading
import time
from collections.abc import Callable, Collection, Coroutine
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import BaseModel, ValidationError
from tornado.websocket import WebSocketClosedError, WebSocketHandler

from mauvecl.answers.verbs import VERBS
from mauvecl.device.drivers import DeviceError
from mauvecl.device.engine import Engine
from mauvecl.host import VERSION
from mauvecl.observations.frame_files import ColumnNames
from mauvecl.runs.checkpoint import Stopped
from mauvecl.runs.pool import LocalWorkers, Pool
from mauvecl.schema.errors import InputError, shortened
from mauvecl.web import page
from mauvecl.web.closed_forms import ClosedForms, other_payloads, solved
from mauvecl.web.fields import FIELDS, field_of, remedies, sentence
from mauvecl.web.page import SIMULATIONS, TABS, State, card, known_values, reads_of
from mauvecl.web.sandboxed_reader import EXPECTED_FRAMES, read_limited
from mauvecl.web.tab import DRAWN_UNITS, QUESTIONS, simulate
from mauvecl.web.uploads import RESULTS, UPLOAD_SHELF, UPLOADS

if TYPE_CHECKING:
    from mauvecl.web.closed_forms import Answers
    from mauvecl.web.tab import Tab

TOGETHER = 2  # number of simulations that the server computes at the same time; others wait
LONG_S = 1.0  # duration above which the memory of a simulation is released, which stops all visitors for a moment
REPORT_S = 0.25  # time between two reports of a simulation's progress
MOST_ANSWERS = 12  # number of simulated answers that the server keeps per visitor
MOST_TASKS = 8  # number of requests of a visitor that the server works on at the same time
UNUSED = 4000  # code with which the connection of an unused page is closed
#: Message about an error of the page itself.
OWN_FAULT = "the page failed, and there is no answer; this is a fault of mauvecl: please report what was entered"
#: Entries of the replies to requests that are refused.
REFUSED: dict[str, dict[str, Any]] = {
    "solve": {"solved": ""}, "pinned": {"pins": {}}, "columns": {"columns": []}, "file": {"file": ""},
    "simulate": {"ended": ""},
}  # fmt: skip
#: Fields of the section `data`, which state how files of frames are read.
DATA = {name for name, field in FIELDS.items() if field.path[:1] == ("data",)}
#: Uploads are read one after the other, outside the event loop.
READER = ThreadPoolExecutor(1, thread_name_prefix="mauvecl-upload")
#: Sets the exception that a thread raises at its next bytecode, or with None clears a pending one.
_set_pending = ctypes.pythonapi.PyThreadState_SetAsyncExc
_threads, _per_thread = ThreadPoolExecutor(TOGETHER, thread_name_prefix="mauvecl-page"), threading.local()
log = logging.getLogger(__name__)


def _engine(device: str | None, progress: Callable[[int, int], None]) -> Engine:
    """Return this thread's engine, which reports the progress of this job from any thread."""
    if not hasattr(_per_thread, "engine"):
        listener = _per_thread.listener = [progress]
        _per_thread.engine = Engine(device, progress=lambda done, total: listener[0](done, total))
    _per_thread.listener[0] = progress
    engine: Engine = _per_thread.engine
    return engine


def release_memory() -> None:
    """Free what simulations leave: arrays in reference cycles, which Python finds late, and pages that malloc keeps."""
    gc.collect()
    getattr(ctypes.CDLL(None), "malloc_trim", lambda pad: pad)(0)


class Interruption(BaseException):
    """Raised in a thread to end its work; no Exception, since libraries catch these."""


@dataclass(eq=False)
class Job:
    """Simulation for a visitor."""

    #: Computes the answer from a pool and, if there is a unit, a function that receives counts of it.
    ask: Callable[..., Any]
    #: Whether realisations are drawn. Such a job is cancelled between two tiles, others anywhere by an exception.
    drawing: bool = True
    unit: str = ""  # of the progress; realisations of the pool if empty
    _cancelled: bool = False
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _thread: int | None = None
    _pool: Pool | None = None
    _started: float | None = None
    _counted: tuple[int, int] = (0, 0)
    _remaining_s: float = math.inf

    def __post_init__(self) -> None:
        self.future: Future[Any] = _threads.submit(self._run)

    def _run(self) -> Any:
        if not self.drawing:
            with self._lock:
                self._thread = threading.get_ident()
        try:
            self._started = time.monotonic()
            self._pool = Pool(LocalWorkers(make=_engine))
            if self._cancelled:
                raise Stopped
            return self.ask(self._pool, self._count) if self.unit else self.ask(self._pool)
        except BaseException as error:
            if self._cancelled:
                # Some libraries turn an interruption into an error of their own.
                raise Stopped from error
            raise
        finally:
            # A pending interruption would otherwise reach the next work of this thread.
            with self._lock:
                if self._thread is not None:
                    _set_pending(ctypes.c_ulong(self._thread), None)
                self._thread = None
            if time.monotonic() - (self._started or math.inf) > LONG_S:
                release_memory()

    def _count(self, done: int, total: int) -> None:
        self._counted = done, total

    def cancel(self) -> None:
        """Cancel the job: between two tiles if it draws, anywhere if it does not, or before it starts."""
        with self._lock:
            if self._thread is not None and not self._cancelled:
                _set_pending(ctypes.c_ulong(self._thread), ctypes.py_object(Interruption))
            self._cancelled = True
        # The exception does not reach fits in other threads, which end between two of their draws.
        if self._pool is not None:
            self._pool.stop()
        self.future.cancel()

    @property
    def progress(self) -> tuple[float, str]:
        """Completed share, and the progress in words; the estimated time never rises."""
        if self._started is None:
            return 0.0, "waiting for its turn"
        standing, elapsed_s = None if self._pool is None else self._pool.standing, time.monotonic() - self._started
        done, total = self._counted if self.unit or standing is None else (standing.done, standing.total)
        duration = f"{elapsed_s:.0f} s"
        if not total:
            return 0.0, duration
        if 0 < done < total:
            self._remaining_s = min(self._remaining_s, elapsed_s * (total - done) / done)
            duration = f"about {self._remaining_s:.0f} s left"
        return min(done / total, 1.0), f"{done:,} of {total:,} {self.unit or 'realisations'}, {duration}"


class Request(BaseModel):
    """Message of a page, whose entries depend on what it asks; answers have the same number ``n``."""

    ask: str
    n: int = 0
    link: str = ""  # with the fields
    tab: str = ""
    kind: str = ""  # of a simulation
    field: str = ""  # of an upload
    name: str = ""  # of a file
    ending: str = ""

    @property
    def front(self) -> Tab:
        """The named tab, or the first one."""
        return TABS.get(self.tab, next(iter(TABS.values())))


class Visitor(WebSocketHandler):
    """WebSocket connection of a page; of several pending questions, only the last is answered."""

    #: All visitors with an open connection.
    connected: set[Visitor] = set()  # noqa: RUF012
    #: Whether a visitor has left since memory was released.
    has_left = False

    def initialize(self) -> None:
        """Set up a new connection."""
        self.used = time.monotonic()
        self.job: Job | None = None
        self._drawing: Job | None = None
        self._next: Request | None = None
        self._answering: asyncio.Task[None] | None = None
        self._solving = 0
        self._tasks: set[asyncio.Task[None]] = set()
        self._announced: Request | None = None
        self._digests: dict[str, str] = {}
        self._home = tempfile.TemporaryDirectory(prefix="mauvecl-page-")
        self._folder = Path(self._home.name)

    def check_origin(self, origin: str) -> bool:
        """Accept every origin, since `server.PageApplication` has checked it."""
        return True

    def open(self, *args: str, **kwargs: str) -> None:
        """Register the visitor."""
        self.connected.add(self)
        self.send(hello=VERSION)

    def on_close(self) -> None:
        """Cancel all work for a visitor who has left."""
        self.connected.discard(self)
        for job in (self.job, self._drawing):
            if job is not None:
                job.cancel()
        self._home.cleanup()
        for shelf in (RESULTS, UPLOAD_SHELF):
            shelf.drop(self)
        Visitor.has_left = True

    def send(self, content: bytes | None = None, **message: Any) -> None:
        """Send a message, followed by bytes; a visitor who has left gets none."""

        def log_error(sent: asyncio.Future[None]) -> None:
            error = None if sent.cancelled() else sent.exception()
            if error is not None and not isinstance(error, WebSocketClosedError):
                log.error("a message could not be sent", exc_info=error)

        if self.ws_connection is None or self not in self.connected:
            return
        with contextlib.suppress(WebSocketClosedError):
            self.write_message(json.dumps(message, allow_nan=False)).add_done_callback(log_error)
            if content is not None:
                self.write_message(content, binary=True).add_done_callback(log_error)

    def on_message(self, message: str | bytes) -> None:
        """Handle a message; an invalid one closes the connection."""
        self.used = time.monotonic()
        if isinstance(message, bytes) and self._announced is not None:
            self._read_upload(self._announced, message)
            return
        try:
            request = Request.model_validate_json(message)
            answer = getattr(self, f"_ask_{request.ask}")
        except (ValidationError, AttributeError):
            log.warning("a message is not a valid request: %s", shortened(str(message)))
            self.close(1003, "a message must be a question as the page asks it")
            return
        if (work := answer(request)) is None:
            return
        reply = {"n": request.n} | REFUSED.get(request.ask, {})
        if len(self._tasks) < MOST_TASKS:
            self._begin(self._report_errors(work, **reply))
        else:
            work.close()
            self.send(**reply, refused="too many requests at the same time; wait for an answer before the next one")

    # State and answers

    def state(self, link: str) -> State:
        """Enter the values of a link."""
        return State(link, UPLOAD_SHELF.of(self, "upload"))

    def _ask_answer(self, request: Request) -> None:
        """Send the answer and a tab's pictures; a later question replaces a waiting one."""

        async def answer_all() -> None:
            while self._next is not None and self.ws_connection is not None:
                request, self._next = self._next, None
                state, tab = self.state(request.link), request.front
                faults = state.faults_of(tab.reads)
                known = known_values(state)
                message: dict[str, Any] = {"n": request.n, "stray": state.stray, "faults": faults, "known": known}
                if faults:
                    self.send(**message)
                else:
                    await self._report_errors(self._answer(message, state, tab), **message)

        self._next = request
        if self._answering is None or self._answering.done():
            self._answering = self._begin(answer_all())

    async def _answer(self, message: dict[str, Any], state: State, tab: Tab) -> None:
        closed = await asyncio.to_thread(self.closed, state, tab)
        answers = self.answers(state)
        self.send(**message, answer=await asyncio.to_thread(card, tab, closed, answers))
        if self._next is None:
            self.send(n=message["n"], **await asyncio.to_thread(content_of, tab, closed, answers))

    def closed(self, state: State, tab: Tab) -> ClosedForms:
        """Return the closed forms of the part of a question that a tab reads; the last ones are cached."""
        key = self._key(state, tab.reads), tab.chance
        closed: ClosedForms | None = RESULTS.get(self, "closed", key)
        if closed is None:
            inputs = self.inputs(state, tab)
            closed = ClosedForms.of(state.question(tab.reads), self._folder, chance=tab.chance, inputs=inputs)
        # Closed forms cache more values when they are used, so that their size is counted again.
        RESULTS.keep(self, "closed", key, closed)
        return closed

    def inputs(self, state: State, tab: Tab) -> dict[str, Any]:
        """Return the content of the files that a tab reads; the last ones are cached."""
        key, question = (tab.name, self._key(state, tab.reads & (UPLOADS.keys() | DATA))), state.question(tab.reads)
        inputs: dict[str, Any] | None = RESULTS.get(self, "inputs", key)
        if inputs is None:
            try:
                inputs = tab.read_inputs(question) if tab.needs in question.uploads else {}
            except InputError as error:
                raise InputError(str(error), key=tab.needs or error.key) from error
            RESULTS.keep(self, "inputs", key, inputs)
        return inputs

    def answers(self, state: State) -> dict[str, Any]:
        """Return the simulated answers that hold for a question, by name."""
        valid: dict[str, Any] = {}
        for (simulation, key), answers in RESULTS.of(self, "answers").items():
            if key == self._key(state, reads_of(simulation)):
                valid |= answers
                RESULTS.get(self, "answers", (simulation, key))
        return valid

    def _key(self, state: State, names: Collection[str]) -> tuple[Any, ...]:
        """Return everything on which an answer to some fields depends."""
        return state.texts(names), *(self._digests.get(name) for name in UPLOADS if name in names)

    def _begin(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        """Run a function without blocking other visitors."""
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task

    async def _report_errors(self, work: Coroutine[Any, Any, None], **message: Any) -> None:
        """Run a function, and report an invalid request or an internal error."""
        try:
            await work
        except InputError as error:
            # If values exclude each other, the message stands at one of their fields.
            name = field_of(error.key) if "faults" in message else None
            reason = {"refused": sentence(error)} if name is None else {"faults": {name: sentence(error)}}
            self.send(**message | reason)
        except DeviceError as error:
            self.send(**message, refused=str(error))
        except Exception:
            log.exception("no answer")
            self.send(**message, refused=OWN_FAULT)

    async def _ask_solve(self, request: Request) -> None:
        """Send the limit of the quantity for which the question solves, and the chances with other payloads."""
        n = self._solving = request.n
        closed = await asyncio.to_thread(self.closed, self.state(request.link), next(iter(TABS.values())))
        if n != self._solving:
            # The limit takes long for a bright star, and a later question waits.
            self.send(n=n, solved="")
            return
        self.send(n=n, payloads=await asyncio.to_thread(other_payloads, closed))
        self.send(n=n, solved=await asyncio.to_thread(solved, closed))

    async def _ask_pinned(self, request: Request) -> None:
        """Send the data of a pinned scenario for a tab's pictures."""
        tab = request.front
        closed = await asyncio.to_thread(ClosedForms.of, self.state(request.link).question(tab.reads), self._folder)
        pictures = (await asyncio.to_thread(content_of, tab, closed, {}))["pictures"]
        self.send(n=request.n, pins={p.name: pictures[p.name]["sources"][p.pins] for p in tab.pictures if p.pins})

    # Draws and simulations

    async def _ask_draw(self, request: Request) -> None:
        """Draw one exposure with the flare, in place of one that is being drawn."""
        state, tab = self.state(request.link), request.front
        key = self._key(state, tab.reads), tab.chance
        closed: ClosedForms | None = RESULTS.get(self, "closed", key)
        if closed is None:
            return
        if self._drawing is not None:
            self._drawing.cancel()
        options = closed.case.draw_options | {"seed": closed.study.run.seed}
        job = self._drawing = Job(lambda pool: pool.realise(closed.flare, count=1, **options)[0])
        try:
            spectrum = await asyncio.wrap_future(job.future)
        except (Exception, asyncio.CancelledError):
            # Another draw took its place, or a simulation will report the error.
            return
        if RESULTS.get(self, "closed", key) is closed:
            self.send(n=request.n, **content_of(tab, closed, self.answers(state) | {"draw": spectrum}))

    async def _ask_simulate(self, request: Request) -> None:
        """Simulate, report progress, and send the answer."""
        n, kind, state = request.n, request.kind, self.state(request.link)
        if self.job is not None or kind not in SIMULATIONS or state.faults_of(reads_of(kind)):
            raise InputError("a simulation is running already, or there is nothing to simulate")
        key = kind, self._key(state, reads_of(kind))
        question, tab = state.question(reads_of(kind)), SIMULATIONS[kind]
        inputs = await asyncio.to_thread(self.inputs, state, tab)
        closed = await asyncio.to_thread(ClosedForms.of, question, self._folder, chance=tab.chance, inputs=inputs)
        if self.job is not None:
            raise InputError("a simulation is running already: wait until it ends")
        main, *more = QUESTIONS[kind].verbs
        unit = VERBS[main].counts
        ask = partial(simulate, kind, closed.study, inputs=closed.inputs)
        # Several verbs count the realisations of all in the pool.
        job = self.job = Job(ask, unit in DRAWN_UNITS, "" if more else unit)
        answers = asyncio.wrap_future(job.future)
        try:
            while not (await asyncio.wait([answers], timeout=REPORT_S))[0]:
                share, words = job.progress
                self.send(n=n, progress=share, message=words)
            RESULTS.keep(self, "answers", key, answers.result(), MOST_ANSWERS)
            self.send(n=n, ended=f"Done: {job.progress[1]}.", kind=kind)
        except (Interruption, Stopped, CancelledError, asyncio.CancelledError):
            self.send(n=n, ended="Cancelled.")
        finally:
            self.job = None

    def _ask_cancel(self, request: Request) -> None:
        if self.job is not None:
            self.job.cancel()

    # Files from and to the visitor

    def _ask_upload(self, request: Request) -> None:
        """Expect a file in the next message."""
        if request.field in UPLOADS:
            self._announced = request

    def _read_upload(self, request: Request, content: bytes) -> None:
        """Read an uploaded file in a thread; its field is empty until then."""
        field, name, state = request.field, request.name, self.state(request.link)
        self._announced, upload = None, UPLOADS[field]
        UPLOAD_SHELF.drop(self, "upload", field)
        options = tuple(state.entered[name] for name in upload.fields)
        self._digests[field] = hashlib.sha256(content + repr(options).encode()).hexdigest()

        async def read() -> None:
            reply: dict[str, Any] = {"n": request.n, "field": field}
            try:
                work = READER.submit(lambda: upload.read(name, content, state.question(upload.fields).values))
                UPLOAD_SHELF.keep(self, "upload", field, await asyncio.wrap_future(work), len(UPLOADS))
                reply["entered"] = upload.entered
            except InputError as error:
                reply["lacks"] = sentence(error, upload.options)
                pairs = remedies(error, upload.options)
                reply["remedies"] = [(name, value) for name, value in pairs if name in upload.fields]
            except Exception as error:
                log.exception("an upload failed")
                reply["lacks"] = f"upload {shortened(name)} cannot be read ({type(error).__name__}); give another"
            self.send(**reply)

        self._begin(read())

    async def _ask_columns(self, request: Request) -> None:
        """Send the names of the columns of the visitor's frames; none if they are no table."""
        file, names = UPLOAD_SHELF.get(self, "upload", "frames"), tuple[str, ...]()
        if file is not None:
            frames, expected = {file.name: file.content}, EXPECTED_FRAMES
            work = READER.submit(read_limited, ColumnNames, ColumnNames.read, frames, expected=expected)
            names = (await asyncio.wrap_future(work)).names
        self.send(n=request.n, columns=names)

    async def _ask_file(self, request: Request) -> None:
        """Send a table, document or study."""
        name, state = request.name, self.state(request.link)

        def make() -> tuple[str, bytes]:
            if (tab := TABS.get(request.tab)) is not None:
                return page.as_file(tab, name, request.ending, self.closed(state, tab), self.answers(state))
            # The page asks for the study of a question by its name alone.
            tab = next((tab for tab in TABS.values() if name in tab.questions), None)
            if tab is None:
                raise InputError(f"no tab asks {name[:40]!r}; give a question of a tab")
            # A simulation asks what its own answers depend on, which their tables state.
            question = state.question(reads_of(name) if name in SIMULATIONS else tab.reads)
            return page.study_file(QUESTIONS[name].study(question.case(self._folder).study), "study")

        file, content = await asyncio.to_thread(make)
        self.send(content, n=request.n, file=file)

    async def _ask_export(self, request: Request) -> None:
        """Send a tab's questions as commands and as Python programs."""
        question = self.state(request.link).question(request.front.reads)
        taken = await asyncio.to_thread(page.commands_and_programs, request.front, question, self._folder)
        self.send(n=request.n, taken=taken)


def content_of(tab: Tab, closed: ClosedForms, answers: Answers) -> dict[str, Any]:
    """Return the pictures and the table of a tab as entries of a message."""
    pictures = {}
    for picture in tab.pictures:
        drawing = pictures[picture.name] = picture.drawn(closed, answers)
        for columns in drawing["sources"].values():
            columns.update({name: encoded(values) for name, values in columns.items()})
    return {"tab": tab.name, "pictures": pictures, "rows": tab.rows(closed, answers)}


def encoded(values: Any) -> Any:
    """Encode numbers as base64 of little-endian 32-bit floats; return other values unchanged."""
    if len(values) and not isinstance(values[0], (str, list)):
        array = np.asarray(values, "<f4")
        return {"f4": base64.b64encode(array.tobytes()).decode(), "shape": list(array.shape)}
    return list(values)
