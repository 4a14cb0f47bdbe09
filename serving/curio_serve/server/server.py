"""The server's life: open the port, load the models, watch for new ones, drain, leave."""

import contextlib
import logging
import socket
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import grpc
from curio_proto.inference import inference_pb2
from curio_proto.v1 import detector_pb2
from grpc_health.v1 import health, health_pb2
from grpc_reflection.v1alpha import reflection, reflection_pb2
from prometheus_client import CollectorRegistry

from curio_serve import memory
from curio_serve.api.admission import WorkQueue
from curio_serve.api.kserve import InferenceService
from curio_serve.api.pose_detector import Limits, PoseService
from curio_serve.api.registration import register
from curio_serve.cores import memory_limit, num_cores
from curio_serve.errors import ModelError, Unavailable, UsageError
from curio_serve.models.model_check import ChildCheck
from curio_serve.models.model_folder import MODEL_FILE, MODELS_OF_RUN, versions
from curio_serve.models.repository import Change, Repository
from curio_serve.models.runtime import Runtime, on_processor, read_providers
from curio_serve.server.config import ServeConfig
from curio_serve.server.metrics_port import MetricsPort
from curio_serve.server.reception import Reception, ReceptionLimits
from curio_serve.server.security import TokenInterceptor, Tokens, read_tokens, server_credentials
from curio_serve.telemetry import Metrics, log

_POSE = detector_pb2.DESCRIPTOR.services_by_name["PoseDetector"]
_INFERENCE = inference_pb2.DESCRIPTOR.services_by_name["GRPCInferenceService"]
_HEALTH = health_pb2.DESCRIPTOR.services_by_name["Health"]
_REFLECTION = reflection_pb2.DESCRIPTOR.services_by_name["ServerReflection"]
_SERVING, _NOT_SERVING = health_pb2.HealthCheckResponse.SERVING, health_pb2.HealthCheckResponse.NOT_SERVING


_MEMORY_USED = 0.8  # of a container's memory, beyond which streams are ended
_MEMORY_OF_MODELS = 0.6  # of it, beyond which little is left for requests
_DEVICE_BATCH = 8  # of a GPU provider
_HEARING_S = 1.0
_DRAINING_S = 0.2


class PoseServer:
    """One server: :meth:`start`, then :meth:`serve_until_stopped`, which :meth:`stop` ends from anywhere."""

    def __init__(self, config: ServeConfig) -> None:
        self.config = config
        registry = CollectorRegistry()
        self._registry = registry
        self._metrics = Metrics(registry)
        providers = read_providers(config.provider)
        batch = config.batch or (1 if on_processor(providers) else _DEVICE_BATCH)
        self._check = ChildCheck()
        self._repository = Repository(Path(config.models), config.versions, Runtime(providers, batch), self._check)
        # Calls that wait for a batch leave their core to others, which decode meanwhile.
        workers = config.workers or num_cores() + (batch if batch > 1 else 0)
        self._reception = Reception(_reception_limits(config))
        self._work = WorkQueue(workers, config.queue, self._metrics, self._reception.num_behind)
        # Watchers of health wait without a thread each.
        watchers = ThreadPoolExecutor(1)
        self._health = health.HealthServicer(experimental_non_blocking=True, experimental_thread_pool=watchers)
        self._inference = InferenceService(self._repository, self._work, self._metrics)
        self._server: grpc.Server | None = None
        self._stopped = threading.Event()
        limits = Limits(
            config.max_pixels,
            config.max_regions,
            config.max_models,
            config.max_streams,
            config.min_confidence,
            config.full_decode,
        )
        self._pose = PoseService(self._repository, self._work, limits, self._metrics)

    def start(self) -> list[str]:
        """Load the models and open the ports.

        Returns:
            The addresses that answer: gRPC's, and the metrics' URL where they are on.

        Raises:
            ModelError: No model can be loaded.
            Unavailable: A port is taken.
            UsageError: A certificate, key or token file cannot be used.
        """
        # Frames run in parallel already, one a core; OpenCV's own threads would only get in their way.
        cv2.setNumThreads(1)
        memory.bound_heaps()
        changes = self._repository.refresh()
        self._report(changes)
        if not list(self._repository):
            raise ModelError(f"no model could be loaded from {self.config.models}: {self._why_none(changes)}")
        _warn_of_little_memory(memory.resident_bytes(), memory_limit())
        self._server = self._build()
        addresses = [self._open_port(self._server)]
        if self.config.metrics_port is not None:
            addresses.append(self._open_metrics(self.config.metrics_port))
        self._reception.start()
        self._server.start()
        self._announce()
        return addresses

    def _why_none(self, changes: Sequence[Change]) -> str:
        """What to do about a folder none of whose models serves."""
        if changes:
            return "the log says why each was refused"
        folder = Path(self.config.models)
        if versions(folder):
            return f"it is the folder of one model; give the folder that holds it, {folder.absolute().parent}"
        if (folder / MODELS_OF_RUN).is_dir():
            return f"it is a run of curio-train; give its models, {folder.absolute() / MODELS_OF_RUN}"
        return f"it holds no <name>/<version>/{MODEL_FILE}; export a model with curio-export"

    def _build(self) -> grpc.Server:
        config = self.config
        tokens = Tokens(read_tokens(config.token_file) if config.token_file else ())
        server = grpc.server(
            # Threads are made as calls need them, so their number follows the load; one that waits takes 16 kB.
            ThreadPoolExecutor(config.max_calls, thread_name_prefix="curio-call"),
            interceptors=[TokenInterceptor(tokens, self._metrics)],
            options=channel_options(config),
            maximum_concurrent_rpcs=config.max_calls,
        )
        receive = self._reception.receive
        register(server, _POSE, self._pose, receive, unread=["Detect"])
        register(server, _INFERENCE, self._inference, receive, unread=["ModelInfer"])
        register(server, _HEALTH, self._health, receive)
        names = [service.full_name for service in (_POSE, _INFERENCE, _HEALTH, _REFLECTION)]
        register(server, _REFLECTION, reflection.ReflectionServicer(names), receive)
        return server

    def _open_port(self, server: grpc.Server) -> str:
        host, port = self.config.host, self.config.port
        address = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
        credentials = server_credentials(self.config)
        try:
            bound = server.add_secure_port(address, credentials) if credentials else server.add_insecure_port(address)
        except RuntimeError as exc:
            if reason := _why_not(host, port):
                raise Unavailable(f"cannot listen on {address}: {reason}; choose another --host or --port") from exc
            raise UsageError(
                f"--tls-certificate {self.config.tls_certificate} and --tls-key {self.config.tls_key} cannot be used; "
                "expected PEM files of a certificate (chain) and its own key"
            ) from exc
        return f"{address.rsplit(':', 1)[0]}:{bound}"

    def _open_metrics(self, port: int) -> str:
        try:
            http = MetricsPort(self.config.host, port, self._registry)
        except OSError as exc:
            raise Unavailable(
                f"cannot serve metrics on port {port}: {exc.strerror}; choose another --metrics-port"
            ) from exc
        http.start()
        host = f"[{self.config.host}]" if ":" in self.config.host else self.config.host
        return f"http://{host}:{http.server_port}/metrics"

    def _announce(self) -> None:
        """Set the health status of the server and of each service and model; without a model nothing serves."""
        names = [name for name, _ in self._repository]
        for name in ("", _POSE.full_name, _INFERENCE.full_name):
            self._health.set(name, _SERVING if names else _NOT_SERVING)
        for name in names:
            self._health.set(name, _SERVING)

    def serve_until_stopped(self) -> None:
        """Answer calls until :meth:`stop`, which may have come during :meth:`start`; then drain."""
        watcher = threading.Thread(target=self._watch, name="curio-watch")
        watcher.start()
        try:
            # Not for ever at once: on Windows no signal is heard meanwhile.
            while not self._stopped.wait(_HEARING_S):
                pass
        finally:
            self._stopped.set()
            self._drain()
            self._check.stop()
            watcher.join()
            log(logging.INFO, "stopped")

    def stop(self) -> None:
        """Begin to drain."""
        self._stopped.set()

    def _drain(self) -> None:
        """Refuse new calls and let accepted ones finish; streams, which have no end, in half of the time."""
        if self._server is None:
            return
        log(logging.INFO, "draining", grace_s=self.config.grace_s)
        self._inference.drain()
        self._health.enter_graceful_shutdown()
        drained, begun_s = self._server.stop(self.config.grace_s), time.monotonic()
        while not drained.wait(_DRAINING_S):
            self._pose.end_streams(idle_alone=time.monotonic() - begun_s < self.config.grace_s / 2)
        self._reception.stop()

    def _watch(self) -> None:
        """Pick up new model versions for as long as the server lives."""
        while self.config.refresh_s and not self._stopped.wait(self.config.refresh_s):
            before = {name for name, _ in self._repository}
            try:
                self._report(self._repository.refresh())
            except ModelError as exc:
                log(logging.ERROR, "models folder unreadable; serving what is loaded", reason=str(exc))
                continue
            self._announce()
            for gone in before - {name for name, _ in self._repository}:
                self._health.set(gone, _NOT_SERVING)

    def _report(self, changes: list[Change]) -> None:
        for change in changes:
            refused = change.event == "refused"
            reason = {"reason": change.reason} if refused else {}
            level = logging.ERROR if refused else logging.INFO
            log(level, f"model {change.event}", model=change.name, version=change.version, **reason)
            self._metrics.refused_models.inc(refused)
        self._metrics.models.set(sum(len(loaded) for _, loaded in self._repository))


def _warn_of_little_memory(used: int, most: int | None) -> None:
    """Say where the models leave little of a container's memory, bytes: requests would be refused for want of it."""
    if most is not None and used > _MEMORY_OF_MODELS * most:
        text = "models leave little memory; streams are ended when it is short"
        log(logging.WARNING, text, used_mb=used >> 20, limit_mb=most >> 20)


def _reception_limits(config: ServeConfig) -> ReceptionLimits:
    most = memory_limit()
    return ReceptionLimits(
        config.max_message_mb << 20,
        config.message_memory_mb << 20,
        config.message_s,
        config.idle_s,
        None if most is None else int(_MEMORY_USED * most),
    )


def channel_options(config: ServeConfig) -> list[tuple[str, int]]:
    """The limits that gRPC itself enforces on every connection."""
    return [
        # Two servers on one port would share its calls without a word.
        ("grpc.so_reuseport", 0),
        ("grpc.max_receive_message_length", config.max_message_mb << 20),
        ("grpc.max_send_message_length", 64 << 20),
        ("grpc.max_metadata_size", 16 << 10),
        # The part of --max-calls that one connection may have. Well above the queue: a call that is refused early
        # counts until its client knows, and calls beyond this limit are reset without the time to come back.
        ("grpc.max_concurrent_streams", 512),
        # Before a message is asked for, 64 kB of it are received; with probing it would be megabytes of each call.
        ("grpc.http2.bdp_probe", 0),
        # Half-open connections are found out; idle clients may ping, but not more often than every 10 s.
        ("grpc.keepalive_time_ms", 60_000),
        ("grpc.keepalive_timeout_ms", 20_000),
        ("grpc.keepalive_permit_without_calls", 1),
        ("grpc.http2.min_ping_interval_without_data_ms", 10_000),
    ]


def _why_not(host: str, port: int) -> str:
    """Why an address cannot be listened on, or empty: gRPC does not pass on the operating system's reason."""
    with contextlib.closing(socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET)) as probe:
        try:
            probe.bind((host, port))
        except OSError as exc:
            return exc.strerror or str(exc)
    return ""
