"""--loss, and configurations from before there was one."""

import json
from pathlib import Path

import msgspec
import pytest

from tests.support.tiny_runs import TINY, run
from warpnerf.checks import InputError
from warpnerf.cli.loss_options import chosen_losses
from warpnerf.config import LossConfig, TrainConfig
from warpnerf.config_json import config_from_json, config_to_json, decode


def test_options_change_the_losses() -> None:
    begun = LossConfig(entropy=0.01)
    assert chosen_losses(begun, ()) == begun
    given = ["distortion=3e-2", "photometric=huber", "huber_delta=0.2", "entropy=0"]
    expected = LossConfig(distortion=0.03, photometric="huber", huber_delta=0.2)
    assert chosen_losses(begun, given) == expected


def test_a_weight_may_be_a_word_or_a_number() -> None:
    begun = chosen_losses(LossConfig(), ["opacity=auto"])
    assert begun == LossConfig(opacity="auto")
    assert chosen_losses(begun, ["opacity=0.5"]) == LossConfig(opacity=0.5)
    with pytest.raises(InputError, match="opacity must be auto or a number, not 'much'"):
        chosen_losses(begun, ["opacity=much"])


@pytest.mark.parametrize(
    ("option", "said"),
    [
        ("l1=1", "--loss: 'l1=1' is no option of the loss; it has photometric=squared, "),
        ("distortion", "--loss: 'distortion' is no option of the loss; it has "),
        ("path/to/it", "--loss: 'path/to/it' is no NAME=VALUE; --loss takes all words up to"),
        ("distortion=much", "--loss: distortion must be a number, not 'much'."),
        ("distortion=-1", "loss.distortion must be a finite number of at least 0, not -1.0."),
        ("entropy=nan", "loss.entropy must be a finite number of at least 0, not nan."),
        ("photometric=l1", "loss.photometric must be one of squared, huber, not 'l1'."),
        ("near_clip=1", "loss.near_clip needs loss.near_clip_distance"),
    ],
)
def test_what_does_not_fit_is_refused(option: str, said: str) -> None:
    with pytest.raises(InputError) as error:
        chosen_losses(LossConfig(), [option])
    assert said in str(error.value)
    with pytest.raises(InputError, match="entropy is given twice"):
        chosen_losses(LossConfig(), ["entropy=1", "entropy=2"])


def test_a_scene_that_an_option_has_taken_is_named(tmp_path: Path) -> None:
    for flag in ("--loss", "--model-options"):
        code, _, err = run("train", "--output", tmp_path / "run", flag, "builtin:room")
        assert code == 2 and f"{flag}: 'builtin:room' is no NAME=VALUE" in err


def test_the_command_refuses_in_a_sentence_and_writes_nothing(tmp_path: Path) -> None:
    for option, said in (
        ("entropy=-1", "loss.entropy must be"),
        ("sample_colour=1", "samples of the model deferred have no colours of their own"),
    ):
        folder = tmp_path / "run"
        code, _, err = run("train", *TINY, "--loss", option, "--output", folder)
        assert code == 2 and said in err and "Traceback" not in err
        assert not folder.exists()


@pytest.mark.slow  # compiles for seconds
def test_a_run_keeps_its_losses(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    options = ["--model", "rgb", "--steps", "30", "--keep", "checkpoint", "--output", folder]
    code, _, err = run("train", *TINY, *options, "--loss", "distortion=0.01", "entropy=0.002")
    assert code == 0, err
    kept = json.loads((folder / "config.json").read_text())["train"]["loss"]
    assert kept["distortion"] == 0.01 and kept["entropy"] == 0.002
    code, _, err = run("train", "--resume", folder, "--loss", "distortion=0.02")
    assert code == 2 and "loss.distortion is 0.02" in err


def test_configurations_are_read_back_and_older_ones_have_the_squared_error() -> None:
    config = TrainConfig(loss=LossConfig(photometric="huber", huber_delta=0.2, distortion=1))
    tree = json.loads(json.dumps(config_to_json(config)))
    assert read(tree) == config
    del tree["loss"]
    assert read(tree).loss == LossConfig()


def read(tree: dict[str, object]) -> TrainConfig:
    return msgspec.convert(config_from_json(tree), TrainConfig, dec_hook=decode)
