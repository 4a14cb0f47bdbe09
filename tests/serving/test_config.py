"""Settings: where they come from, which source wins, and what is refused."""

from pathlib import Path

import pytest
from curio_serve.errors import UsageError
from curio_serve.server.config import ServeConfig, read_config, to_toml


def test_defaults_listen_on_loopback_alone() -> None:
    config = read_config([], {})
    assert config == ServeConfig()
    assert config.host == "127.0.0.1"


def test_flags_win_over_environment_over_file(tmp_path: Path) -> None:
    file = tmp_path / "serve.toml"
    file.write_text('models = "from_file"\nport = 1\nqueue = 1\nmax_pixels = 1000\nprovider = "cuda,cpu"\n')
    environment = {"CURIO_SERVE_PORT": "2", "CURIO_SERVE_QUEUE": "2", "CURIO_SERVE_FULL_DECODE": "true", "HOME": "/x"}
    config = read_config(["--config", str(file), "--queue", "3"], environment)
    assert (config.max_pixels, config.port, config.queue) == (1000, 2, 3)
    assert config.models == "from_file"
    assert config.provider == "cuda,cpu"
    assert config.full_decode
    assert read_config(["given", "--config", str(file)], environment).models == "given"
    assert read_config([], {"CURIO_SERVE_CONFIG": str(file)}).port == 1
    assert read_config([], {"CURIO_SERVE_PROVIDER": "openvino,cpu"}).provider == "openvino,cpu"


def test_what_is_dumped_can_be_read_again(tmp_path: Path) -> None:
    config = read_config(
        ["my models", "--port", "0", "--metrics-port", "9", "--min-confidence", "0.25", "--token-file", 'a"b\\c'], {}
    )
    file = tmp_path / "dumped.toml"
    file.write_text(to_toml(config))
    again = read_config(["--config", str(file)], {})
    assert to_toml(again) == to_toml(config)
    assert again.token_file == Path('a"b\\c')


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--port", "70000"], "--port is 70000"),
        (["--port", "-1"], "--port is -1"),
        (["--metrics-port", "-1"], "--metrics-port is -1"),
        (["--queue", "-1"], "--queue is -1; expected at least 0"),
        (["--min-confidence", "1.5"], "--min-confidence is 1.5"),
        (["--min-confidence", "nan"], "--min-confidence is nan"),
        (["--grace-s", "nan"], "--grace-s is nan"),
        (["--max-message-mb", "5000"], "--max-message-mb is 5000"),
        (["--log-level", "loud"], "--log-level is 'loud'"),
        (["--tls-key", "k.pem"], "come together"),
        (["--client-ca", "ca.pem"], "--client-ca needs --tls-certificate"),
        (["--config", "nowhere.toml"], r"--config nowhere\.toml cannot be read"),
    ],
)
def test_impossible_values_name_the_flag(arguments: list[str], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        read_config(arguments, {})


@pytest.mark.parametrize(
    ("environment", "words"),
    [
        ({"CURIO_SERVE_PROT": "1"}, "CURIO_SERVE_PROT is no setting; known are .*CURIO_SERVE_CONFIG, "),
        ({"CURIO_SERVE_DUMP_CONFIG": "true"}, "CURIO_SERVE_DUMP_CONFIG is no setting"),
        ({"CURIO_SERVE_FULL_DECODE": "maybe"}, "CURIO_SERVE_FULL_DECODE is 'maybe'"),
    ],
)
def test_bad_variables_are_named(environment: dict[str, str], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        read_config([], environment)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("port = ", "is not TOML"),
        ("prot = 1", r"unknown keys \['prot'\]"),
        ("[port]\nx = 1", r"port: found \{.x.: 1\}, expected text or a number"),
    ],
)
def test_bad_files_are_named(tmp_path: Path, text: str, words: str) -> None:
    file = tmp_path / "serve.toml"
    file.write_text(text)
    with pytest.raises(UsageError, match=words):
        read_config(["--config", str(file)], {})


@pytest.mark.parametrize(
    ("arguments", "environment", "source"),
    [
        (["--port", "many"], {}, "curio-serve"),
        ([], {"CURIO_SERVE_PORT": "many"}, "CURIO_SERVE_"),
    ],
)
def test_values_of_another_kind_end_with_usage_and_source(
    arguments: list[str], environment: dict[str, str], source: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as caught:
        read_config(arguments, environment)
    assert caught.value.code == 2
    said = capsys.readouterr()
    assert "--port" in said.err + said.out
    assert source in said.err + said.out


def test_what_belongs_together_may_come_from_several_sources(tmp_path: Path) -> None:
    file = tmp_path / "tls.toml"
    file.write_text('tls_certificate = "c.pem"\n')
    config = read_config(["--config", str(file), "--client-ca", "ca.pem"], {"CURIO_SERVE_TLS_KEY": "k.pem"})
    assert [str(path) for path in (config.tls_certificate, config.tls_key, config.client_ca)] == [
        "c.pem",
        "k.pem",
        "ca.pem",
    ]
    with pytest.raises(UsageError, match="come together"):
        read_config(["--config", str(file)], {})


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ('full_decode = "yes"', "full_decode: found 'yes', expected true or false"),
        ('port = [8500, "mymodels"]', "port: found .*, expected text or a number"),
        ("models = true", "models: found True, expected text or a number"),
    ],
)
def test_values_of_another_kind_in_the_file_are_refused(tmp_path: Path, line: str, told: str) -> None:
    (tmp_path / "b.toml").write_text(line + "\n")
    with pytest.raises(UsageError, match=told):
        read_config(["--config", str(tmp_path / "b.toml")], {})


@pytest.mark.parametrize("flag", ["--refresh-s", "--grace-s", "--idle-s", "--message-s"])
def test_times_without_an_end_are_refused(flag: str) -> None:
    with pytest.raises(UsageError, match="expected at most 1e"):
        read_config([flag, "inf"], {})
