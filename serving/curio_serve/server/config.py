"""Reads the server's settings from flags, environment, TOML file and defaults, in this order."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Self

import tyro

from curio_serve.command_line import parsed
from curio_serve.errors import UsageError
from curio_serve.settings import environment_settings, read_toml, to_arguments

ENV_PREFIX = "CURIO_SERVE_"
_NOT_STORED = {"config", "dump_config"}
_MAX_WORKERS = 1024
_LONGEST_S = 1e9  # thirty years; clocks hold no more


@dataclass(frozen=True)
class ServeConfig:
    """Serve exported models over gRPC.

    Every flag but --config and --dump-config is also an environment variable (--max-pixels is CURIO_SERVE_MAX_PIXELS)
    and a key of the --config file (max_pixels). Flags win over the environment, the environment over the file.
    """

    models: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="[MODELS]")] = "models"
    """Folder of models, <name>/<version>/model.onnx as curio-export writes it, or hf://ORG/NAME[@REVISION] of a hub."""
    host: str = "127.0.0.1"
    """Address to listen on; 0.0.0.0 for all interfaces."""
    port: int = 8500
    """Port for gRPC; 0 takes a free one and prints it."""
    metrics_port: int | None = None
    """Port for Prometheus over HTTP at /metrics; 0 takes a free one; none: off."""
    workers: int = 0
    """Frames worked on at the same time, one thread each; 0: as many as there are cores."""
    queue: int = 64
    """Requests that may wait for a worker; more are answered RESOURCE_EXHAUSTED."""
    max_streams: int = 256
    """Open DetectStream calls."""
    max_calls: int = 4096
    """Open calls of any kind, also those whose message has not come yet."""
    max_message_mb: int = 32
    """Largest request, in MiB."""
    message_memory_mb: int = 256
    """Memory for requests that arrive or wait, in MiB; each counts as the largest until it has arrived."""
    message_s: float = 10.0
    """Seconds in which the first message of a call has to arrive."""
    idle_s: float = 60.0
    """Seconds in which each further message of a stream has to arrive."""
    max_pixels: int = 1 << 25
    """Most pixels of an image; checked before it is decoded."""
    max_regions: int = 64
    """Most regions of interest in a request, and, with --max-models, most runs of a network: models times regions."""
    max_models: int = 16
    """Most models named in a request."""
    min_confidence: float = 0.0
    """Least confidence of a detection where a request says none; 0 to 1."""
    full_decode: bool = False
    """Decode JPEGs at full size even where the model needs fewer pixels (slower)."""
    versions: int = 2
    """Newest versions of each model kept loaded."""
    refresh_s: float = 5.0
    """Seconds between looks for new model versions; 0: never."""
    provider: str = "cpu"
    """onnxruntime's execution providers by preference, with commas: cpu, openvino, cuda, tensorrt, coreml or others."""
    batch: int = 0
    """Most images of several calls in one run of a network; 0: 1 on the CPU, where batches gain nothing, else 8."""
    tls_certificate: Path | None = None
    """Server certificate chain, PEM; with --tls-key turns TLS on."""
    tls_key: Path | None = None
    """Key of the certificate, PEM."""
    client_ca: Path | None = None
    """Authority whose certificates clients must show (mutual TLS), PEM."""
    token_file: Path | None = None
    """File of accepted bearer tokens, one a line; health checks need none."""
    grace_s: float = 30.0
    """Seconds that accepted requests may take to finish after SIGTERM."""
    log_level: str = "info"
    """debug, info, warning or error."""
    config: Path | None = None
    """TOML file with these settings; CURIO_SERVE_CONFIG may name it, too."""
    dump_config: bool = False
    """Print the settings in effect as TOML and stop."""

    def __post_init__(self) -> None:
        """Refuse impossible values.

        Raises:
            UsageError: Names the flag.
        """
        least = {
            "port": 0, "workers": 0, "queue": 0, "max_streams": 0, "max_calls": 1, "max_message_mb": 1,
            "max_pixels": 256, "max_regions": 1, "max_models": 1, "versions": 1, "refresh_s": 0, "batch": 0,
            "message_memory_mb": 1, "message_s": 0.1, "idle_s": 0.1, "grace_s": 0,
        }  # fmt: skip
        for name, smallest in least.items():
            if not getattr(self, name) >= smallest:
                raise UsageError(f"--{_flag(name)} is {getattr(self, name)}; expected at least {smallest}")
        for name in ("port", "metrics_port"):
            if not 0 <= (getattr(self, name) or 0) <= 65535:
                raise UsageError(f"--{_flag(name)} is {getattr(self, name)}; expected 0 to 65535")
        if not 0 <= self.min_confidence <= 1:
            raise UsageError(f"--min-confidence is {self.min_confidence}; expected 0 to 1")
        if self.max_message_mb > 1024:
            raise UsageError(f"--max-message-mb is {self.max_message_mb}; expected at most 1024")
        if self.workers > _MAX_WORKERS:
            raise UsageError(f"--workers is {self.workers}; expected at most {_MAX_WORKERS}")
        if not self.host:
            raise UsageError("--host is empty; expected an address such as 127.0.0.1, or 0.0.0.0 for all interfaces")
        if self.log_level not in ("debug", "info", "warning", "error"):
            raise UsageError(f"--log-level is {self.log_level!r}; expected debug, info, warning or error")
        for name in ("refresh_s", "message_s", "idle_s", "grace_s"):
            if not getattr(self, name) <= _LONGEST_S:
                raise UsageError(f"--{_flag(name)} is {getattr(self, name)}; expected at most {_LONGEST_S:g} seconds")

    def checked(self) -> Self:
        """The settings, once all sources have been read: what belongs together may come from several of them.

        Raises:
            UsageError: They contradict each other.
        """
        if (self.tls_certificate is None) != (self.tls_key is None):
            raise UsageError("--tls-certificate and --tls-key come together; give both or neither")
        if self.client_ca is not None and self.tls_certificate is None:
            raise UsageError(
                "--client-ca needs --tls-certificate and --tls-key: clients show certificates over TLS only"
            )
        return self


def read_config(arguments: list[str], environment: Mapping[str, str]) -> ServeConfig:
    """Settings from all sources.

    Args:
        arguments: Of the command line, without its name.
        environment: Variables.

    Raises:
        UsageError: Names the setting, and the file or variable it came from.
        SystemExit: tyro has printed a usage error (2) or the help (0).
    """
    # A first reading of the flags alone, because one of them names the file.
    flags = _parse(arguments, ServeConfig())
    named = flags.config or environment.get(f"{ENV_PREFIX}CONFIG")
    config = ServeConfig()
    if named:
        config = _parse(_file_arguments(Path(named)), config, f"(settings in {named})")
    config = _parse(_environment_arguments(environment), config, f"(variables {ENV_PREFIX}...)")
    return _parse(arguments, config).checked()


def _parse(arguments: list[str], default: ServeConfig, source: str = "") -> ServeConfig:
    prog = f"curio-serve {source}".strip()
    return parsed(ServeConfig, arguments, prog, default=default)


def _flag(name: str) -> str:
    return name.replace("_", "-")


def _file_arguments(path: Path) -> list[str]:
    content = read_toml(path, "--config")
    known = {field.name for field in fields(ServeConfig)} - _NOT_STORED
    if unknown := content.keys() - known:
        raise UsageError(f"--config {path} has unknown keys {sorted(unknown)}; known are {sorted(known)}")
    for name, value in content.items():
        is_flag = isinstance(getattr(ServeConfig, name), bool)
        if isinstance(value, bool) != is_flag or not isinstance(value, str | int | float):
            expected = "true or false" if is_flag else "text or a number"
            raise UsageError(f"--config {path}, {name}: found {value!r}, expected {expected}")
    return [argument for name, value in content.items() for argument in _arguments(name, value, str(path))]


def _environment_arguments(environment: Mapping[str, str]) -> list[str]:
    known = {field.name for field in fields(ServeConfig)} - {"dump_config"}
    arguments = []
    for variable, name, text in environment_settings(environment, ENV_PREFIX):
        if name not in known:
            names = ", ".join(sorted(ENV_PREFIX + name.upper() for name in known))
            raise UsageError(f"environment variable {variable} is no setting; known are {names}")
        if name != "config":  # the file has been read
            arguments += _arguments(name, _typed(variable, text, getattr(ServeConfig, name)), variable)
    return arguments


def _typed(variable: str, text: str, default: Any) -> Any:
    """A variable's text as the kind of value that its setting has."""
    if isinstance(default, bool):
        if text.lower() not in ("true", "false", "1", "0"):
            raise UsageError(f"{variable} is {text!r}; expected true or false")
        return text.lower() in ("true", "1")
    return text


def _arguments(name: str, value: Any, source: str) -> list[str]:
    """Arguments for the parser; ``models`` is the only setting without a flag."""
    return [str(value)] if name == "models" else to_arguments(name, value, source)


def to_toml(config: ServeConfig) -> str:
    """The settings as a file that --config takes; those that are off are left out."""
    values = {field.name: getattr(config, field.name) for field in fields(config)}
    lines = (
        # JSON's strings, numbers, booleans and lists are TOML's.
        f"{name} = {json.dumps(str(value) if isinstance(value, Path) else value, ensure_ascii=False)}"
        for name, value in values.items()
        if value is not None and name not in _NOT_STORED
    )
    return "\n".join(lines) + "\n"
