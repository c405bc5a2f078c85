"""The form that says who plays: opponent, strength, who begins."""

from thorndike.web.controls import Tag, select
from thorndike.web.looks import look_of
from thorndike.web.opponents import STRENGTHS, Opponent, is_for_one
from thorndike.web.studio import Setup, Studio


class SetupForm:
    """Three choices, with what is chosen in ``setup``."""

    def __init__(self, studio: Studio, setup: Setup) -> None:
        self.setup = self._seen = setup
        self._offered = {opponent.id: opponent for opponent in studio.opponents(setup.game)}
        if setup.opponent not in self._offered:
            # A run may be gone, or its checkpoint have made room for a newer one, since this game began.
            self._offered[setup.opponent] = Opponent(setup.opponent, f"{setup.opponent} (no longer there)", None)
        sides = look_of(setup.game).sides
        with Tag("div", "fields") as fields:
            fields.set_attribute("hidden", True if is_for_one(setup.game) else None)
            self._opponent = select(
                "Opponent", {each.id: each.name for each in self._offered.values()}, setup.opponent, self._choose_opponent
            )
            strengths = {str(number): f"{number:,} simulations a move" for number in STRENGTHS}
            self._strength = select("Strength", strengths, str(setup.simulations), self._choose_strength)
            begins = {"person": f"I do, with {sides[0]}", "opponent": f"The opponent; I play {sides[1]}"}
            self._begins = select("Who begins", begins, "person" if setup.person_begins else "opponent", self._choose_beginner)
        self._update()

    def show(self, setup: Setup) -> None:
        """The setup that holds: where it has changed it replaces what was chosen here and not yet used."""
        if setup != self._seen:
            self.setup = self._seen = setup
            self._update()

    async def _choose_opponent(self, value: str) -> None:
        if value in self._offered:
            self.setup = self.setup._replace(opponent=value)
            self._update()

    async def _choose_strength(self, value: str) -> None:
        if value.isdecimal() and int(value) in STRENGTHS:
            self.setup = self.setup._replace(simulations=int(value))
            self._update()

    async def _choose_beginner(self, value: str) -> None:
        self.setup = self.setup._replace(person_begins=value != "opponent")
        self._update()

    def _update(self) -> None:
        # None where another page chose somebody who was not there yet when this one was made.
        chosen = self._offered.get(self.setup.opponent)
        self._opponent.set_attribute("value", self.setup.opponent)
        self._strength.set_attribute("value", str(self.setup.simulations))
        self._begins.set_attribute("value", "person" if self.setup.person_begins else "opponent")
        self._strength.set_attribute("disabled", None if chosen is None or chosen.searches else True)
        self._begins.set_attribute("disabled", None if chosen is None or chosen.make is not None else True)
