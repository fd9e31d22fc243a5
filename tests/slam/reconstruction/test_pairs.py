"""Which photos are matched: sequences, several folders, neighbours by GPS."""

from __future__ import annotations

from scan2sim.slam.reconstruction.pairs import Pair, following_pairs, near_pairs, sequential_pairs, unique
from scan2sim.slam.reconstruction.photos import Photo


def photo(name: str, time: float | None = None, position: tuple[float, float] | None = None) -> Photo:
    return Photo(name, 640, 480, time=time, position=position)


def across(pairs: list[Pair]) -> set[frozenset[str]]:
    """Pairs of photos in different folders."""
    return {frozenset(pair) for pair in pairs if pair[0].split("/")[0] != pair[1].split("/")[0]}


def test_pairs_of_a_sequence_connect_neighbours_and_distant_photos_once() -> None:
    pairs = list(sequential_pairs([str(i) for i in range(100)]))
    assert len(pairs) == len(set(pairs)) < 100 * 14
    assert {("0", "1"), ("0", "10"), ("0", "64"), ("98", "99")} <= set(pairs) and ("0", "11") not in pairs


def test_a_folder_that_continues_another_is_connected_to_its_end() -> None:
    for timed in (True, False):
        first = [photo(f"100MEDIA/{i}.jpg", float(i) if timed else None) for i in range(200)]
        second = [photo(f"101MEDIA/{i}.jpg", float(200 + i) if timed else None) for i in range(200)]
        pairs = across(following_pairs([*first, *second]))
        assert frozenset({"100MEDIA/199.jpg", "101MEDIA/0.jpg"}) in pairs
        assert frozenset({"100MEDIA/197.jpg", "101MEDIA/2.jpg"}) in pairs
        if timed:
            assert frozenset({"100MEDIA/0.jpg", "101MEDIA/0.jpg"}) not in pairs


def test_cameras_in_parallel_are_connected_by_time_although_one_missed_photos() -> None:
    left = [photo(f"left/{i}.jpg", float(i)) for i in range(100)]
    right = [photo(f"right/{i}.jpg", i + 0.1) for i in range(100) if i % 10]  # every tenth is missing
    pairs = across(following_pairs([*left, *right]))
    for i in range(1, 99):
        j = i if i % 10 else i + 1
        assert frozenset({f"left/{i}.jpg", f"right/{j}.jpg"}) in pairs
    untimed = across(following_pairs([photo(one.name) for one in (*left, *right)]))
    assert frozenset({"left/5.jpg", "right/6.jpg"}) in untimed


def test_strips_of_a_flight_are_connected_by_gps() -> None:
    strips, length = 6, 20
    flight = []
    for row in range(strips):
        columns = range(length) if row % 2 == 0 else reversed(range(length))
        flight += [photo(f"{row}-{column}", position=(52.5 + 2e-4 * row, 13.4 + 3e-4 * column)) for column in columns]
    pairs = {frozenset(pair) for pair in near_pairs(flight)}
    beside = [
        frozenset({f"{row}-{column}", f"{row + 1}-{column}"}) for row in range(strips - 1) for column in range(length)
    ]
    assert set(beside) <= pairs and len(pairs) < 8 * len(flight)
    assert not near_pairs([photo("a"), photo("b", position=(52.5, 13.4))])
    assert len(near_pairs([photo(str(i), position=(52.5, 13.4)) for i in range(3)])) == 3


def test_pairs_are_matched_once_in_either_direction() -> None:
    assert unique([("a", "b"), ("b", "a"), ("a", "c"), ("a", "b")]) == [("a", "b"), ("a", "c")]
