"""Options of scenarios with landmarks."""

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

from coloc_env.options import Count, Group, Metres, PositiveMetres, PositiveSeconds, Seconds, Share
from coloc_env.sensors.base import Sensor
from coloc_env.sensors.landmarks import FieldOfView, Landmarks, Placement
from coloc_env.sensors.sight import Sight
from coloc_env.sensors.unlabelled_landmarks import UnlabelledLandmarks

Association = Literal["known", "unknown"]


@dataclass(frozen=True)
class LandmarkOptions(Group):
    """So many ``landmarks`` stand anywhere in the arena (``landmark_placement``: ``random``, or
    ``symmetric``: unchanged by half a turn about the arena's vertical axis); those within
    ``landmark_radius`` m are seen as position vectors with noise of ``landmark_std`` m per axis.
    With ``association=unknown`` nothing says which landmark a vector is to. A share
    ``false_matches`` of these belongs to another landmark, in each step by chance or the same one
    over ``alias_time`` s, a share ``landmark_dropout`` is missing, and in the times ``range_only``
    (from, to) none is seen. ``landmark_field``: full opening angle of the cone about the body's x
    axis in which they are seen (none: all around). The team believes the Gaussian part alone.
    """

    title: ClassVar[str] = "landmarks"

    landmarks: Count = 20
    landmark_std: Metres = 0.15
    landmark_radius: PositiveMetres = 10.0
    false_matches: Share = 0.0
    landmark_dropout: Share = 0.0
    range_only: tuple[Seconds, Seconds] | None = None
    landmark_field: FieldOfView | None = None
    association: Association = "known"
    alias_time: PositiveSeconds | None = None
    landmark_placement: Placement = "random"

    @property
    def true(self) -> tuple[Landmarks, ...]:
        """The sensor as it is, by landmarks with names and with nothing in the way."""
        wrong = self._seen(self.false_matches, self.landmark_dropout, self.range_only)
        ahead, lasting, where = self.landmark_field, self.alias_time, self.landmark_placement
        return tuple(
            replace(one, field_of_view=ahead, alias_time=lasting, placement=where) for one in wrong
        )

    def behind(self, sight: Sight) -> tuple[Landmarks, ...]:
        """The sensor as it is, with what hides landmarks."""
        return tuple(replace(one, sight=sight) for one in self.true)

    @property
    def believed(self) -> tuple[Landmarks, ...]:
        """The sensor that the team believes in, by landmarks with names."""
        return self._seen()

    def named(self, seen: tuple[Landmarks, ...]) -> tuple[Sensor, ...]:
        """The landmarks as they are seen: with names, or without."""
        if self.association == "known":
            return seen
        return tuple(UnlabelledLandmarks(one) for one in seen)

    def _seen(self, *wrong: Any) -> tuple[Landmarks, ...]:
        if not self.landmarks:
            return ()
        return (Landmarks(self.landmarks, self.landmark_std, self.landmark_radius, *wrong),)
