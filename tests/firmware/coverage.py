"""Run of the C core's sequences, which tests/firmware/test_coverage.py measures: `python -m tests.firmware.coverage LIBRARY`.

The sequences are those of the other tests in this folder, fewer of each, and the ones below for what chance does not reach.
"""

import sys
from pathlib import Path

from tests.firmware import test_board, test_memory, test_rules
from tests.firmware.library import load

RULES, BOARDS = 200, 12


def run(path: Path) -> None:
    """Make all calls."""
    library = load(path)
    for seed in range(RULES):
        test_rules.compare(library, seed)
    for seed in range(BOARDS):
        test_board.compare(library, seed)
    keyed = test_memory.keyed_memory(library)
    test_memory.test_an_order_is_not_obeyed_before_its_timestamp_is_kept(library, keyed)
    test_memory.test_a_board_whose_settings_cannot_be_read_takes_nothing(library, keyed)
    test_memory.test_zeros_are_kept_and_the_older_ones_where_the_newest_are_torn(library)
    test_memory.test_streams_older_than_a_minute_or_too_many_are_refused_and_unused_ones_freed(library, keyed)
    for name, value in (("SLEW_US_S", -1.0), ("THR_NEUTRAL_US", 1890.0)):
        test_memory.test_kept_parameters_that_no_board_may_have_are_those_of_the_build(library, keyed, name, value)
    test_rules.test_of_more_texts_than_find_room_the_newest_are_kept(library)
    for changes in test_rules.PUSHING.values():
        test_rules.test_a_change_that_could_have_a_disarmed_board_push_is_refused(library, changes)
    test_memory.test_values_of_another_table_are_not_taken_but_the_key_is(library, keyed)
    test_memory.test_the_newest_record_is_taken_through_the_wrap_of_its_count(library, keyed)


if __name__ == "__main__":
    run(Path(sys.argv[1]))
