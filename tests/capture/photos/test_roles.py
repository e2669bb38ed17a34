from gsbake.capture.photos import roles


def test_every_nth_photo_is_held_out() -> None:
    assert roles.held_out(12, 6) == [3, 9] and roles.held_out(5, 8) == [] and roles.held_out(10, 0) == []


def test_held_out_photos_are_validation_or_test_photos_in_turn() -> None:
    assert roles.validation_photos(36, 8) == [4, 20] and roles.test_photos(36, 8) == [12, 28]
