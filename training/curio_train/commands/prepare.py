"""What a world's options need before anything is trained: data is fetched, files of one's own are examined.

What is found out here is written into the run's configuration, so that a run keeps it whatever becomes of the files.
"""

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from curio_train.commands.linemod_data import with_linemod
from curio_train.config import MethodName, NetworkConfig, RunConfig
from curio_train.errors import DataError, UsageError
from curio_train.learning.runs.configuration import CONFIG_FILE, load_config
from curio_train.worlds.options import CaptureOptions, LinemodOptions

_IN_ANY_COLOR = "it is learned in any colour, which takes longer"


def prepared(config: RunConfig, cache: Path, warn: Callable[[str], None], report: Callable[[str], None]) -> RunConfig:
    """The configuration of a new run, ready to be trained.

    Args:
        config: As called.
        cache: Where downloads are kept.
        warn: Called with what is doubtful.
        report: Called with what was found out.

    Raises:
        UsageError: Pseudo-labels are asked for, and there are no photographs; LineMOD has no such class; or a
            download was declined; or there are photographs that the method does not learn from, or flags that it
            has no use for.
        DataError: A download failed, or files of one's own are certain not to work.
    """
    options = config.world
    if config.terms.templates:
        _without_training(config, warn)
    if config.recipe.self_training and getattr(options, "photos", None) is None:
        raise UsageError(
            f"--self-training {config.recipe.self_training}: found no photographs to learn from; expected --photos, "
            "which linemod and capture have"
        )
    if isinstance(options, LinemodOptions):
        if options.photos is not None and not (config.terms.sleep or config.terms.renders_predictions):
            raise UsageError(
                f"--photos {options.photos}: --method {config.method} does not learn from photographs; leave it out"
            )
        if options.photos is not None and not config.recipe.self_training:
            warn(f"--photos {options.photos}: with --self-training 0 nothing is learned from them; give a fraction")
        options = with_linemod(_with_stages(options, config.method), cache, report)
        config = replace(config, world=options)
        _refuse_unreadable(options)
    if isinstance(options, CaptureOptions):
        if options.names_several and config.recipe.self_training:
            raise UsageError(
                f"--self-training {config.recipe.self_training}: several parts in free space are not learned from "
                "photographs; leave it out, or train a model of each part"
            )
        if options.plane is not None:
            _refuse_unlearnable(config, options.plane)
        from curio_train.doctor.examine import refuse_unfit

        learns = config.recipe.self_training > 0 and (config.terms.sleep or config.terms.renders_predictions)
        for doubt in refuse_unfit(options, self_training=learns):
            warn(doubt)
        options = _with_sha256(_with_judged(_with_paint(options, config, report), config.init))
        return replace(config, world=options, network=_usual_network(config, options))
    return config


def _without_training(config: RunConfig, warn: Callable[[str], None]) -> None:
    """Say which flags are for training: budgets may stand in a project file, but a first network would be expected."""
    if config.init is not None:
        raise UsageError(f"--init {config.init} has no effect with --method templates, which trains nothing")
    for flag in ("minutes", "images"):
        if (given := getattr(config, flag)) is not None:
            warn(f"--{flag} {given} has no effect with --method templates, which trains nothing")
    options = config.world
    if isinstance(options, CaptureOptions) and options.names_several:
        raise UsageError(
            f"--method templates reads one part, found {len(options.mesh)} --mesh; leave out --method: the default "
            "finds several parts and reads them by templates; or give one mesh"
        )


def _refuse_unlearnable(config: RunConfig, plane: Path) -> None:
    """Refuse what learning from photographs of a plane has no use for."""
    if config.terms.label:
        raise UsageError(
            f"--method {config.method}: it learns from true poses, and photographs have none; leave it out, or give "
            "--method sleep, our or noncur"
        )
    if config.recipe.self_training:
        raise UsageError(
            f"--self-training {config.recipe.self_training}: it is for crops of a part in free space, and parts on a "
            f"plane are read in whole photographs; leave it out, or --plane {plane}"
        )


def _with_stages(options: LinemodOptions, method: MethodName) -> LinemodOptions:
    """One object is read in two stages where a method needs them: only sleep trains a locator beside templates."""
    needs_stages = method != LinemodOptions.default_method and options.gaze and not options.names_several
    return replace(options, two_stage=True) if needs_stages else options


def with_kept_meshes(config: RunConfig, run: Path) -> RunConfig:
    """Write the triangles of CAD files into the run's folder, and let the configuration name those.

    What the run learns, and every later look at it, then depends neither on the CAD file nor on its tessellator.

    Args:
        config: As :func:`prepared`.
        run: The folder of the new run; nothing is written into one that holds a run.

    Raises:
        DataError: The folder cannot be written.
        MeshError: A CAD file cannot be read.
    """
    options = config.world
    if not isinstance(options, CaptureOptions) or (run / CONFIG_FILE).exists():
        return config
    from curio_train.meshes.cad import CAD_SUFFIXES
    from curio_train.meshes.meshes import load_mesh, to_ply

    kept = list(options.mesh)
    for i, file in enumerate(options.mesh):
        if file.suffix.lower() not in CAD_SUFFIXES:
            continue
        kept[i] = Path(os.path.abspath(run)) / "meshes" / f"{file.stem}.ply"
        try:
            kept[i].parent.mkdir(parents=True, exist_ok=True)
            draft = kept[i].with_suffix(f".{os.getpid()}.tmp")  # torchrun's processes each write it
            draft.write_bytes(to_ply(load_mesh(file, options.mesh_unit, options.body)))
            draft.replace(kept[i])
        except OSError as exc:
            raise DataError(f"{kept[i]} cannot be written ({exc.strerror}); choose another --out") from exc
    if kept == list(options.mesh):
        return config
    return replace(config, world=replace(options, mesh=tuple(kept), body=None))


def _usual_network(config: RunConfig, options: CaptureOptions) -> NetworkConfig:
    """Parts on a plane are read by the dense decoder, unless the call, the paper, or wake–sleep wants it otherwise."""
    if options.plane is None or config.network.reading is not None:
        return config.network
    whole = config.preset == "paper" or config.terms.perturbs_predictions
    return replace(config.network, reading="whole" if whole else "cells")


def _refuse_unreadable(options: LinemodOptions) -> None:
    """Frames for self-training are first needed when most of the budget is spent: too late to hear of a broken one."""
    if options.photos is None or options.data is None:
        return
    from curio_train.data.bop import BopDataset
    from curio_train.data.photographs import Photographs, read_frame
    from curio_train.worlds.linemod import read_camera_poses

    camera = BopDataset(options.data).camera
    paths = Photographs(options.photos).paths
    for path in paths:
        read_frame(path, camera)
    if options.views is not None:
        read_camera_poses(options.views, paths)


def _with_sha256(options: CaptureOptions) -> CaptureOptions:
    """Note which mesh files the run is of."""
    from curio_train.meshes.meshes import load_mesh

    meshes = [load_mesh(file, options.mesh_unit, options.body) for file in options.mesh]
    return replace(options, mesh_sha256=tuple(mesh.sha256 for mesh in meshes))


def _with_judged(options: CaptureOptions, init: Path | None) -> CaptureOptions:
    """In free space, choose the photographs that judge the model, and set their names.

    They are those of the run that the network begins with, if that learned from the same folder.
    """
    from curio_train.camera import load_intrinsics
    from curio_train.worlds.capture import CapturePhotographs
    from curio_train.worlds.single_object.two_stage import frame_camera

    if options.plane is not None:
        return options
    camera = load_intrinsics(options.camera)
    photographs = CapturePhotographs(
        options.photos, options.background, camera, frame_camera(camera), _judged_before(options, init)
    )
    return replace(options, judged=photographs.names_judged())


def _judged_before(options: CaptureOptions, init: Path | None) -> tuple[str, ...]:
    """Names of the photographs in the folder that judged the run, or the model within one, that a network is of."""
    if init is None:
        return ()
    run = next((folder for folder in (init, *init.absolute().parents[:3]) if (folder / CONFIG_FILE).is_file()), None)
    before = None if run is None else load_config(run).world
    return before.judged if isinstance(before, CaptureOptions) and before.photos == options.photos else ()


def _with_paint(options: CaptureOptions, config: RunConfig, report: Callable[[str], None]) -> CaptureOptions:
    """In free space, find an unpainted part's colour in photographs over a background image, and set it."""
    from curio_train.camera import load_intrinsics
    from curio_train.data.part_color import find_color, is_unpainted
    from curio_train.meshes.meshes import load_mesh

    if options.plane is not None or options.paint is not None:
        return options
    are_unpainted = [is_unpainted(load_mesh(file, options.mesh_unit, options.body)) for file in options.mesh]
    if not any(are_unpainted):
        return options
    by_templates = options.names_several or config.terms.templates
    drawn = "it is drawn in grey, and hardly found if it has another one" if by_templates else _IN_ANY_COLOR
    anyway = f"{drawn}; --paint '#8a6f4c' says which it has"
    if options.background is None:
        report(f"the part's colour is not known without --background, a photograph of the empty scene: {anyway}")
        return options
    if not all(are_unpainted):
        report(f"the colour of parts without one is not looked for beside parts that have their own: {anyway}")
        return options
    found = find_color(options.photos, options.background, load_intrinsics(options.camera))
    if found is None:
        report(f"the part's colour was not found where the photographs differ from {options.background}: {anyway}")
        return options
    report(f"the part's colour, from {found.num_used} of {found.num_compared} photographs: {found.hex}")
    return replace(options, paint=found.hex)
