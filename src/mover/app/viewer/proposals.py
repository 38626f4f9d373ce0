"""Supports that a run proposes: ghosts that the tab `Object` accepts or dismisses."""

from typing import Any

from mover.app.viewer.session import Session
from mover.app.viewer.window import Window
from mover.core.types import Proposal


def add_proposals(window: Window) -> None:
    """Fill the part of the tab; it is hidden where nothing is proposed."""
    gui, session = window.server.gui, window.session
    folder = gui.add_folder("Proposed", visible=False)
    with folder:
        choice = gui.add_dropdown("Support", [""])
        about = gui.add_markdown("")
        accept = gui.add_button("Accept", hint="An object like any other: Solve again places it")
        dismiss = gui.add_button("Dismiss", color="red")

    def refresh() -> None:
        proposals = session.proposals
        folder.visible = bool(proposals)
        names = [one.object.id for one in proposals]
        if names:
            choice.options = names
            choice.value = choice.value if choice.value in names else names[0]
            about.content = _about(_chosen(session, choice.value))

    @choice.on_update
    def _(_event: Any) -> None:  # noqa: ANN401
        about.content = _about(_chosen(session, choice.value))

    accept.on_click(lambda _event: session.accept(choice.value))
    dismiss.on_click(lambda _event: session.dismiss(choice.value))
    session.listen(refresh)


def _chosen(session: Session, name: str) -> Proposal | None:
    return next((one for one in session.proposals if one.object.id == name), None)


def _about(proposal: Proposal | None) -> str:
    if proposal is None:
        return ""
    return (
        f"A {proposal.object.category} that no detector saw: {proposal.bodies} bodies rest there"
        f" for {proposal.seconds:.0f} s, certainty {proposal.certainty:.2f}."
    )
