"""Metrics compared by drive: the direction of each, and those that are no longer scored."""

from crosscue.eval.scoring.by_drive import DriveMetric, no_longer_scored


def test_metrics_of_unpaired_drives_are_not_reported_as_lost() -> None:
    """A fleet with one more drive has conditions that the other lacks."""

    def of(log: str, metric: str) -> DriveMetric:
        return DriveMetric(log, metric, "mean", 1.0, 1)

    dusk, recall = "cues.stop_sign.by_condition.dusk.recall", "cues.stop_sign.recall"
    before = [of("monday", recall), of("tuesday", recall), of("tuesday", dusk)]

    assert no_longer_scored(before, [of("monday", recall)]) == ()
    assert no_longer_scored(before, [of("monday", recall), of("tuesday", recall)]) == (dusk,)
