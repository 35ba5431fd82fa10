"""Event functions of the page: each acts on the page's session and returns updates of components.

Separating waits in the line of all pages: its functions are generators that tell how far they are. A playing page asks
for frame after frame; each answer has the next one if it is ready, with the current edits.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import replace
from typing import Any

import gradio as gr

from polsep.io.raw.frames import HEADERLESS
from polsep.io.store.samples import DEMO, DEMO_WHITE
from polsep.view.components import (
    HINT,
    IMAGES,
    MENDS,
    NO_SHAPE,
    NOTHING,
    OF_FILES,
    PAUSE,
    RESULT_AS_IS,
    SAME,
    Components,
    Start,
    Updates,
    Values,
    failure_line,
    one_line,
    status_line,
)
from polsep.view.edits import list_controls, recipe_of
from polsep.view.images import KINDS
from polsep.view.opening import OpenedFrame, parse_against, parse_settings
from polsep.view.pictures import Exposure, Picture, Place, Window, exposure_panel, light_panel, shape_panel, stage
from polsep.view.readout import read_pixel, readout_panel
from polsep.view.session import Session, Superseded
from polsep.view.sessions import Sessions
from polsep.view.style import EMPTY

#: Errors of files, settings and disks; each message is one line.
FAILURES = (ValueError, OSError, MemoryError, RuntimeError)
#: Seconds between two words on progress.
WORD_S = 0.3


class Events:
    """Functions of the page's events; ``values``: of the components, by component."""

    def __init__(self, sessions: Sessions, components: Components, start: Start) -> None:
        self.sessions, self.components, self.start = sessions, components, start

    async def open_upload(self, values: Values, request: gr.Request) -> AsyncIterator[Updates]:
        """Open files that the user uploaded."""
        sent = [_claim(file) for file in values[self.components.file] or ()]
        async for update in self._open(lambda: self.sessions.open_upload(_key(request), sent), values, request):
            yield update

    async def open_demo(self, values: Values, request: gr.Request) -> AsyncIterator[Updates]:
        """Open the example frame of polsep, whose levels are known."""
        settings, known = self.components.settings, {**OF_FILES, "white": f"{DEMO_WHITE:g}"}
        said = {settings[name]: value for name, value in known.items()}
        session = self._session(request)
        async for update in self._open(lambda: session.begin_own(DEMO), values, request, said):
            yield update

    async def open_own(self, file: Any, values: Values, request: gr.Request) -> AsyncIterator[Updates]:
        """Open the file named on the command line."""
        session = self._session(request)
        async for update in self._open(lambda: session.begin_own(file), values, request):
            yield update

    def mend(self, place: int) -> Callable[[Values, gr.Request], AsyncIterator[Updates]]:
        """A function that separates again as a remark advises."""

        async def answer(values: Values, request: gr.Request) -> AsyncIterator[Updates]:
            found = self._session(request).opened
            mends = () if found is None else found.mends()
            said = {self.components.settings[m.setting]: m.value for m in mends[place : place + 1]}
            async for update in self.separate({**values, **said}, request):
                yield said | update
                said = {}  # as in `_open`

        return answer

    async def _open(
        self, prepare: Callable[[], None], values: Values, request: gr.Request, said: Updates | None = None
    ) -> AsyncIterator[Updates]:
        """Open a file. The settings of files begin anew with it, unless the page keeps them or had no file before."""
        session, settings = self._session(request), self.components.settings
        first, session.playing = not session.sources, False
        emptied = {self.components.file: None}  # for the next upload
        try:
            await asyncio.to_thread(prepare)
        except FAILURES as error:
            await asyncio.to_thread(session.forget)
            self.sessions.line.leave(_key(request))
            yield emptied | self._failed(error, session)
            return
        self.sessions.line.leave(_key(request))  # the job of the files before, whatever its settings
        if said is None:
            names = [] if first or values[self.components.keep] else list(OF_FILES)
            if any(source.path.suffix.lower() in HEADERLESS for source in session.sources):
                names = [name for name in names if name not in ("size", "pixel_format")]
            said = {settings[name]: value for name, value in self.start.of_files().items() if name in names}
        first_words = emptied | said
        async for update in self.separate({**values, **said, settings["index"]: 0}, request):
            yield first_words | update
            first_words = {}  # once: whoever changes a setting while the file is separated keeps it

    async def separate(self, values: Values, request: gr.Request) -> AsyncIterator[Updates]:
        """Separate the session's file with the settings of the page; tell the progress meanwhile."""
        session, parts = self._session(request), self.components
        try:
            said = {name: values[component] for name, component in parts.settings.items()}
            demo = [source.path for source in session.sources] == [DEMO]  # by another sensor than the user's
            settings = parse_settings(said if demo else self.start.corrections() | said)
            against = parse_against(values[parts.view["against"]], settings)
        except FAILURES as error:
            self.sessions.line.leave(_key(request))  # what is made by other settings than the page's is not shown
            yield self._failed(error, session)
            return
        self._see(session, values)
        key, about = _key(request), (settings, against)
        if self.sessions.line.has(key, about):  # lists fire twice: when chosen, and when left
            yield self._kept()
            return
        if session.made(settings) is not None and (against is None or session.made(against) is not None):
            self.sessions.line.leave(key)
            try:
                yield await self._show(session, await asyncio.to_thread(session.separate, settings, against))
            except Superseded:  # by other files
                yield self._kept()
            return
        ticket = self.sessions.line.join(key, lambda ticket: session.separate(*about, lambda: ticket.wanted), about)
        task = asyncio.wrap_future(ticket.future)
        try:
            while not (await asyncio.wait({task}, timeout=WORD_S))[0]:
                words = f'<span role="status">{ticket.describe()}</span>'
                yield {parts.progress: words, parts.cancel: gr.update(visible=True)}
            if task.cancelled() or not ticket.wanted:
                raise Superseded
            yield await self._show(session, task.result())
        except Superseded:  # said here too: words on their way to the page would replace what `cancel` says
            ended = self._kept() if session.sources else self._idle()
            yield self._cancelled(session) if ticket.by_user else ended
        except FAILURES as error:
            yield self._failed(error, session)
        finally:
            ticket.cancel()

    def cancel(self, request: gr.Request) -> Updates:
        """Leave the line, or drop what is being separated."""
        self.sessions.line.leave(_key(request), by_user=True)
        return self._cancelled(self._session(request))

    def _cancelled(self, session: Session) -> Updates:
        kept = "" if session.opened is None else ": the picture is as before"
        return {**self._idle(), self.components.progress: f'<span role="status">Cancelled{kept}</span>'}

    def _kept(self) -> Updates:
        """No change; Gradio takes an empty update for a missing one, and a generator's for None everywhere."""
        return {self.components.stage: gr.skip()}

    def _idle(self) -> Updates:
        return {self.components.progress: "", self.components.cancel: gr.update(visible=False)}

    async def _show(self, session: Session, found: OpenedFrame) -> Updates:
        """Show a frame; without its picture if a later one was begun meanwhile, and not at all if it was closed."""
        session.turn += 1
        turn = session.turn
        shown = await asyncio.to_thread(self._panels, session, found)
        if session.opened is not found:
            return self._kept()
        return shown if turn == session.turn else shown | self._kept()

    def _panels(self, session: Session, found: OpenedFrame) -> Updates:
        parts, mends = self.components, found.mends()
        unfit = {type(edit) for edit in session.dropped}
        controls = zip(parts.controls, list_controls(), strict=True)
        refused = session.against is None and session.view["against"] != SAME
        offered = [gr.update(visible=True, value=mend.words) for mend in mends[:MENDS]]
        offered += [gr.update(visible=False)] * (MENDS - len(offered))
        return {
            **self._idle(),
            parts.status: status_line(found, (RESULT_AS_IS,) if refused else ()),
            **({parts.view["against"]: SAME} if refused else {}),
            parts.stage: self._stage(session),
            parts.readout: self._readout(session),
            parts.exposure: exposure_panel(found.frame, found.histogram),
            parts.light: light_panel(found.frame, found.small),
            parts.shape: NO_SHAPE,
            parts.strip: gr.update(visible=found.count > 1),
            parts.settings["index"]: gr.update(maximum=max(found.count - 1, 1), value=found.index),
            **self._play_state(session),
            **self._image_names(session),
            **{component: control.start for component, control in controls if control.edit in unfit},
            **dict(zip(parts.mends, offered, strict=True)),
        }

    def _failed(self, error: BaseException, session: Session) -> Updates:
        """Show the error in the status; pictures stay if there is still a frame."""
        session.playing, parts = False, self.components
        nothing = {parts.stage: EMPTY, parts.readout: HINT, parts.strip: gr.update(visible=False)}
        nothing |= {parts.exposure: NOTHING, parts.light: NOTHING, parts.shape: NO_SHAPE}
        return {
            **self._idle(),
            parts.status: failure_line(error),
            **({} if session.opened is not None else nothing),
            **self._play_state(session),
            **self._image_names(session),
            **{button: gr.update(visible=False) for button in parts.mends},
        }

    def _see(self, session: Session, values: Values) -> None:
        """Note what the pictures show from now on: a separation that ends later draws that."""
        session.view = {name: values[component] for name, component in self.components.view.items()}

    async def draw(self, values: Values, request: gr.Request) -> Updates:
        """Draw the same frame with other pictures or another exposure."""
        session = self._session(request)
        self._see(session, values)
        return await self._drawn(session)

    async def _drawn(self, session: Session) -> Updates:
        """The new picture, unless a later one was begun meanwhile: answers may overtake each other."""
        session.turn += 1
        turn = session.turn
        drawn = await asyncio.to_thread(self._stage, session)
        return {self.components.stage: drawn} if turn == session.turn else self._kept()

    async def sharpen(self, request: gr.Request, event: gr.EventData) -> Updates:
        """Draw the part of the frame that the page shows at the screen's resolution."""
        session = self._session(request)
        try:
            if not await asyncio.to_thread(session.sharpen, Window.parse(event.window)):
                return self._kept()
        except FAILURES:
            return self._kept()
        return await self._drawn(session)

    async def point(self, request: gr.Request, event: gr.EventData) -> Updates:
        """Keep the clicked pixel, and show its numbers."""
        session = self._session(request)
        if session.opened is None:
            return self._kept()
        session.mark = _share(event.y), _share(event.x)
        parts = self.components
        shown = {parts.beside: gr.update(selected="pixel"), parts.readout: self._readout(session)}
        return await self._drawn(session) | shown

    def hover(self, request: gr.Request, event: gr.EventData) -> Updates:
        """Show the numbers of the pixel under the pointer; beside the picture, of the one that was clicked."""
        place = None if event.x is None else (_share(event.y), _share(event.x))
        return {self.components.readout: self._readout(self._session(request), place)}

    async def edit(self, values: Values, request: gr.Request) -> Updates:
        """Show the frame with the edits of the controls as the right picture."""
        session = self._session(request)
        try:
            await asyncio.to_thread(session.edit, self._recipe(session, values))
        except FAILURES as error:
            return {self.components.status: failure_line(error)}
        return await self._edited(session, values)

    async def undo(self, values: Values, request: gr.Request) -> Updates:
        """Remove all edits and their images."""
        session, starts = self._session(request), [control.start for control in list_controls()]
        await asyncio.to_thread(session.edit, recipe_of(starts))
        await asyncio.to_thread(session.drop_images)
        controls = dict(zip(self.components.controls, starts, strict=True))
        return await self._edited(session, values) | self._image_names(session) | controls

    def add_image(self, kind: str) -> Callable[[Values, gr.Request], Awaitable[Updates]]:
        """A function that uses an uploaded image of a kind for edits; a first texture is applied at once."""

        async def answer(values: Values, request: gr.Request) -> Updates:
            session, component = self._session(request), self.components.images[kind]
            amount = self.components.control("texture", "amount")
            values = values | {amount: values[amount] or 1.0} if kind == "texture" else values
            try:
                sent = _claim(values[component])
                await asyncio.to_thread(self.sessions.add_image, _key(request), kind, *sent)
                await asyncio.to_thread(session.edit, self._recipe(session, values))
            except FAILURES as error:
                said = {self.components.status: failure_line(error)} | self._image_names(session)
                return await self._drawn(session) | said
            return await self._edited(session, values) | self._image_names(session) | {amount: values[amount]}

        return answer

    def _recipe(self, session: Session, values: Values) -> Any:
        names = {kind: sent.name for kind, sent in session.images.items()}
        return recipe_of([values[control] for control in self.components.controls], names)

    def toggle(self, request: gr.Request) -> Updates:
        """Play or pause."""
        session = self._session(request)
        session.toggle()
        return self._play_state(session)

    async def settle(self, values: Values, request: gr.Request) -> AsyncIterator[Updates]:
        """After a pause, show numbers and panels of the current frame."""
        session = self._session(request)
        if session.playing or session.opened is None or session.place == session.opened.index:
            yield self._kept()
            return
        values = {**values, self.components.settings["index"]: session.place}
        async for update in self.separate(values, request):
            yield update

    async def advance(self, request: gr.Request) -> Updates:
        """Show the next frame of a playing sequence, if it is ready."""
        session = self._session(request)
        try:
            if not await asyncio.to_thread(session.play):
                return self._kept()
        except FAILURES as error:
            session.playing = False
            return {self.components.status: failure_line(error)} | self._play_state(session)
        return await self._drawn(session) | {self.components.settings["index"]: session.place}

    async def _edited(self, session: Session, values: Values) -> Updates:
        session.against, view = None, self.components.view
        chosen = {view["left"]: "Input", view["right"]: "Edited", view["against"]: SAME}
        remarks = session.recipe.cautions()
        status = {} if session.opened is None else {self.components.status: status_line(session.opened, remarks)}
        self._see(session, {**values, **chosen})
        return {**await self._drawn(session), **chosen, **status}

    async def find_shape(self, request: gr.Request) -> Updates:
        """Find the surface of the opened frame, and show it under a lamp that the pointer moves."""
        session = self._session(request)
        found = session.opened
        if found is None:
            return {self.components.shape: NO_SHAPE}
        try:
            panel = await asyncio.to_thread(shape_panel, found.frame, found.stem)
        except FAILURES as error:
            return {self.components.status: failure_line(error)}
        return {self.components.shape: gr.skip() if session.opened is not found else panel}

    def write(self, kind: str) -> Callable[[gr.Request], Updates]:
        """A function that writes one of `DOWNLOADS` and returns its path."""

        def answer(request: gr.Request) -> Updates:
            session = self._session(request)
            try:
                return {self.components.link: str(session.write(kind))}
            except FAILURES as error:
                raise gr.Error(one_line(error), print_exception=False) from error

        return answer

    def leave(self, request: gr.Request) -> None:
        """End the session of a closed page."""
        self.sessions.end(_key(request))

    def _session(self, request: gr.Request) -> Session:
        return self.sessions.find(_key(request))

    def _stage(self, session: Session) -> Any:
        shown, found, other = session.shown, session.opened, session.against
        if shown is None or found is None:
            return EMPTY
        said = session.view
        exposure = Exposure(float(said["stops"]), float(said["specular_stops"]), bool(said["marks"]))
        sharp = session.sharp or (None, None)
        second, right, makers = shown, str(said["right"]), ("", "")
        if other is not None and session.place == found.index:  # what plays is of one method
            second, makers = replace(other.small, gain=shown.gain), session.makers
            if right == "Edited" and shown.edited is not None:  # only the other picture is
                right = "Input"
        pictures = (
            Picture(str(said["left"]), shown, makers[0], sharp[0]),
            Picture(right, second, makers[1], sharp[1]),
        )
        width = max(frame.frame.valid.shape[1] for frame in (found, other) if frame is not None)
        return stage(pictures, exposure, Place(width, session.mark, session.window))

    def _readout(self, session: Session, place: tuple[float, float] | None = None) -> str:
        place = place or session.mark
        found, other = session.opened, session.against
        if place is None or found is None:
            return HINT
        if session.place != found.index:
            return PAUSE if session.playing else HINT
        pairs = [(found, session.makers[0] if other is not None else ""), (other, session.makers[1])]
        tables = []
        for frame, maker in pairs:
            if frame is not None:
                sides = frame.frame.valid.shape
                at = [min(int(share * side), side - 1) for share, side in zip(place, sides, strict=True)]
                tables.append(readout_panel(read_pixel(frame.frame, frame.mosaic, (at[0], at[1])), maker))
        return "".join(tables)

    def _play_state(self, session: Session) -> Updates:
        """Updates of the play button and the timer."""
        words = "Pause" if session.playing else "Play"
        return {self.components.play: gr.update(value=words), self.components.timer: gr.update(active=session.playing)}

    def _image_names(self, session: Session) -> Updates:
        """Labels of the upload buttons with the names of their images."""
        names = {kind: session.images[kind].name if kind in session.images else "none" for kind in KINDS}
        return {self.components.images[kind]: gr.update(label=f"{IMAGES[kind]}: {names[kind]}") for kind in KINDS}


def _key(request: gr.Request) -> str:
    return str(request.session_hash)


def _claim(sent: object) -> tuple[object, str]:
    """Path and name of an uploaded file, as the client claims."""
    upload = sent if isinstance(sent, dict) else {}
    return upload.get("path"), str(upload.get("orig_name") or upload.get("path") or "")


def _share(value: object) -> float:
    """A share of a side, from 0 to 1 for any value of a client."""
    number = float(value) if isinstance(value, (int, float)) else 0.0
    return min(max(number, 0.0), 1.0) if math.isfinite(number) else 0.0
