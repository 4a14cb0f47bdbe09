"""Puts a model's folder on a hub as one commit, with a card that the hub reads.

::

    README.md           the hub's card: metadata (licence, pipeline tag, library, tags), how to run the model, CARD.md
    NAME/…              the folder, as export/folder.py describes it

curio_serve.models.hub reads ``hf://ORG/NAME``.
"""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from curio_proto.v1.model_spec_pb2 import ModelSpec
from curio_serve import errors as serving
from curio_serve.models.hub import SCHEME, check_sums, first_line, is_repository, models_in, open_hub, timeout_s
from curio_serve.models.model_folder import SUMS_FILE, listed_sums, load_version
from huggingface_hub import CommitOperationAdd, HfApi, ModelCardData, ModelInfo
from huggingface_hub.errors import (
    HfHubHTTPError,
    HTTPError,
    LocalEntryNotFoundError,
    LocalTokenNotFoundError,
    RepositoryNotFoundError,
)

from curio_train.errors import ExportError, UsageError
from curio_train.export.folder import ModelFolder

_PIPELINE = "object-detection"  # the nearest of the hub's tasks, of which none is pose estimation
_TAGS = ("pose-estimation", "6dof-pose-estimation", "onnx")
# Licences of meshes, as cards and the hub name them.
_LICENCES = {"CC BY-SA 4.0": "cc-by-sa-4.0", "CC BY 4.0": "cc-by-4.0"}


def check_repository(name: str) -> None:
    """Refuse a name that no repository can have.

    Raises:
        UsageError: Says what was expected.
    """
    if not is_repository(name):
        raise UsageError(f"--push {name}: expected ORG/NAME, letters, digits, _, - and . in either part")


def push(folder: Path, repository: str, licence: str | None) -> str:
    """Make a repository hold a model's folder; one that is not there yet is made, and is private.

    Args:
        folder: OUT/NAME, as an export wrote it.
        repository: ``ORG/NAME``.
        licence: As the hub spells it; None: that of the mesh, if the card names one.

    Returns:
        Where the commit can be seen.

    Raises:
        UsageError: The repository's name is malformed, or the hub does not let this user write there.
        ExportError: The folder is damaged, the repository has what would be lost, or the hub does not answer.
    """
    check_repository(repository)
    model = ModelFolder(folder.resolve())
    latest = model.versions()[-1]
    try:
        check_sums(model.path)
        spec = load_version(model.path, latest).spec
    except serving.ModelError as exc:
        raise ExportError(str(exc)) from exc
    card = hub_card(repository, model.card(), spec, licence)
    files = {path.relative_to(model.path.parent).as_posix(): path for path in model.files()}
    with _as_our_errors(repository):
        hub = open_hub()
        there = _repository(hub, repository)
        _refuse_loss(hub, repository, there, model.path)
        added = [CommitOperationAdd("README.md", card.encode()), *(CommitOperationAdd(*item) for item in files.items())]
        message = f"{model.path.name}, version {latest}"
        # Of the state that was looked at: who pushes at the same time is not overwritten.
        done = hub.create_commit(repository, added, commit_message=message, parent_commit=there.sha)
    return str(done.commit_url)


def hub_card(repository: str, card: str, spec: ModelSpec, licence: str | None) -> str:
    """The README.md of a repository.

    Args:
        repository: ``ORG/NAME``.
        card: CARD.md.
        spec: Of the latest version.
        licence: As the hub spells it; None: that of the mesh, if the card names one.
    """
    names = (kind.name for kind in spec.objects)
    data = ModelCardData(
        license=licence or next((spelt for name, spelt in _LICENCES.items() if name in card), None),
        library_name="curio-pose",
        pipeline_tag=_PIPELINE,
        tags=list(dict.fromkeys([*_TAGS, spec.world, *names])),
    )
    camera = " --camera camera.json" if spec.camera.camera_matrix and not spec.camera.is_default else ""
    return f"""---
{data.to_yaml()}
---

```sh
pip install 'curio-pose[hub]'
curio-detect {SCHEME}{repository} images/{camera} --out poses.jsonl
curio-serve {SCHEME}{repository}
```

{card}"""


def _repository(hub: HfApi, name: str) -> ModelInfo:
    """The state of a repository, made if there is none."""
    try:
        return hub.model_info(name, timeout=timeout_s())
    except RepositoryNotFoundError:
        hub.create_repo(name, private=True)
    return hub.model_info(name, timeout=timeout_s())


def _refuse_loss(hub: HfApi, repository: str, there: ModelInfo, folder: Path) -> None:
    """Refuse a repository with another model, or with versions that the folder lacks or has otherwise."""
    models = models_in(file.rfilename for file in there.siblings or ())
    if others := models.keys() - {folder.name}:
        raise UsageError(
            f"--push {repository}: holds the model {', '.join(sorted(others))}; push {folder.name} to a repository of "
            "its own"
        )
    if not models:
        return
    with tempfile.TemporaryDirectory() as aside:
        sums = hub.hf_hub_download(repository, f"{folder.name}/{SUMS_FILE}", revision=there.sha, local_dir=aside)
        theirs, ours = listed_sums(Path(sums).parent), listed_sums(folder)
    lost = sorted({file.partition("/")[0] for file, sha256 in theirs.items() if ours.get(file) != sha256})
    if lost:
        raise ExportError(
            f"--push {repository}: its version {', '.join(lost)} is missing or another one in {folder}, and would be "
            "lost; push to another repository"
        )


@contextmanager
def _as_our_errors(repository: str) -> Iterator[None]:
    """Turns what the hub and the network may say into our errors."""
    failure = f"--push {repository}"
    try:
        yield
    except serving.UsageError as exc:
        raise UsageError(str(exc)) from exc
    except LocalTokenNotFoundError as exc:
        raise UsageError(f"{failure}: {_LOG_IN}") from exc
    except HfHubHTTPError as exc:
        status, text = exc.response.status_code, exc.server_message or first_line(exc)
        if status in (401, 403, 404):
            raise UsageError(f"{failure}: the hub refuses it ({text}); {_LOG_IN}") from exc
        if status in (409, 412):
            raise ExportError(
                f"{failure}: somebody else has changed it meanwhile; give the same command again"
            ) from exc
        raise ExportError(f"{failure}: the hub answers {status}: {text}") from exc
    except (HTTPError, ConnectionError, LocalEntryNotFoundError) as exc:
        raise ExportError(f"{failure}: the hub does not answer: {first_line(exc)}; try again later") from exc
    except ValueError as exc:  # the hub does not take the card's metadata
        raise ExportError(f"{failure}: {' '.join(str(exc).split())}") from exc


_LOG_IN = "log in with a token that may write there (hf auth login), or set HF_TOKEN"
