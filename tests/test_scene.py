"""Scene files: defaults, and one clear error for everything that can be wrong with one."""

import tomllib

import pytest

from ncs_jax.errors import InputError
from ncs_jax.prepare.setting import with_cell
from ncs_jax.scene.spec import PRESETS, Scene, load_scene, scene_from, template


def write(folder, text):
    path = folder / "scene.toml"
    path.write_text(text)
    return path


def test_everything_has_a_default(tmp_path):
    assert load_scene(write(tmp_path, "[garment]\n")).to_dict() == Scene().to_dict()


def test_a_scene_survives_its_own_tables(tmp_path):
    scene = load_scene(write(tmp_path, "[physics]\ngravity = [0, 0, -9.81]\n[network]\ndecoder = [64, 64]\n"))
    assert scene_from(scene.to_dict()).to_dict() == scene.to_dict()
    assert scene.physics.gravity == (0, 0, -9.81) and scene.network.decoder == (64, 64)


def test_the_template_has_every_field_and_is_the_defaults(tmp_path):
    text = template()
    assert load_scene(write(tmp_path, text)).to_dict() == Scene().to_dict()
    assert tomllib.loads(text) == {k: _lists(v) for k, v in Scene().to_dict().items()}


def _lists(value):
    if isinstance(value, dict):
        return {k: _lists(v) for k, v in value.items()}
    return list(value) if isinstance(value, tuple) else value


def test_a_preset_takes_the_place_of_the_scenes_own_values(tmp_path):
    path = write(tmp_path, "[network]\ndecoder = [7]\nmodes = 3\njoint = [9]\n[training]\nbatch = 5\nsteps = 9\n")
    for name, tables in PRESETS.items():
        scene = load_scene(path, name)
        assert scene.network.decoder == tables["network"]["decoder"] and scene.training.batch == 5
        assert scene.network.joint == (9,) and scene.training.steps == tables["training"]["steps"]
    assert load_scene(path).network.decoder == (7,)
    assert load_scene(write(tmp_path, "[garment]\n"), "balanced").to_dict() == Scene().to_dict()
    with pytest.raises(InputError, match="a table expected"):
        load_scene(write(tmp_path, "network = 3"), "fast")
    with pytest.raises(InputError, match=r"preset: one of fast, balanced, accurate expected .found 'quick'"):
        load_scene(path, "quick")
    costs = [sum(PRESETS[name]["network"]["decoder"]) * PRESETS[name]["training"]["steps"] for name in PRESETS]
    assert list(PRESETS) == ["fast", "balanced", "accurate"] and costs == sorted(set(costs))


def test_relative_paths_resolve_from_the_file(tmp_path):
    scene = load_scene(write(tmp_path, '[garment]\nfile = "shirt.obj"'))
    assert scene.path(scene.garment.file) == tmp_path / "shirt.obj"
    assert scene.to_dict()["garment"]["file"] == str(tmp_path / "shirt.obj")


@pytest.mark.parametrize("name", ["demo", "tshirt", "skirt", "dress"])
def test_packaged_scenes_are_good(name):
    assert load_scene(f"ncs:{name}").path("ncs:body").is_file()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[physics]\ndensty = 0.1", ["physics.densty", "unknown key", "density"]),
        ("[phisics]\n", ["phisics", "unknown key", "physics"]),
        ('[physics]\ndensity = "heavy"', ["physics.density", "a number expected", "'heavy'"]),
        ('[motion]\nfps = "30"', ["motion.fps", "a number expected", "write it without quotes: fps = 30"]),
        ("[physics]\ndensity = -1", ["physics.density", "from 0.0001", "-1"]),
        ("[physics]\ndensity = nan", ["physics.density", "nan"]),
        ('[network]\ncell = "linear"\nstatic = [8, 7]', ["network.static", "[8, 7]", "even"]),
        ("[physics]\ngravity = [0, 9.81]", ["physics.gravity", "three numbers"]),
        ("[physics]\ngravity = 9.81", ["physics.gravity", "a list expected"]),
        ("[physics]\ninertia = 1", ["physics.inertia", "true or false"]),
        ('[physics.membrane]\nmodel = "rubber"', ["physics.membrane.model", "stvk", "'rubber'"]),
        ("[training]\nsteps = 1.5", ["training.steps", "whole number", "1.5"]),
        ("[training]\nlearning_rate = 0", ["training.learning_rate", "above 0"]),
        ("[network]\ndecoder = []", ["network.decoder", "at least one"]),
        ("[network]\ndecoder = [512, 0]", ["network.decoder[1]", "from 1"]),
        ("physics = 3", ["physics", "a table expected"]),
        ('body = "b.glb"', ["body: a table expected", 'write file = "b.glb" below [body]']),
        ("[physics.collision]\nthickness = 8", ["from 0 to 0.1", "8 mm are 0.008 m: write thickness = 0.008"]),
        ("[physics.collision]\nreach = 80", ["80 mm are 0.08 m: write reach = 0.08"]),
        ("[physics.self_contact]\nthickness = 3", ["3 mm are 0.003 m: write thickness = 0.003"]),
        ("[garment]\nweld = 2", ["2 mm are 0.002 m: write weld = 0.002"]),
        ("[physics]\ndensity = 15000", ["15000 g/m^2 are 15 kg/m^2"]),
        ('[garment]\nfile = ""', ["garment.file", "a garment is needed"]),
        ("[physics", ["not TOML"]),
        ("# only a comment", ["a scene expected", "an empty file", "[garment]"]),
        ('[motions]\nfiles = ["ncs:walk"]', ["motions: unknown key (found 'a table')", "did you mean motion?"]),
    ],
)
def test_one_error_names_file_field_value_and_mend(tmp_path, text, words):
    path = write(tmp_path, text)
    with pytest.raises(InputError) as caught:
        load_scene(path)
    message = str(caught.value)
    assert "\n" not in message
    for word in [str(path), *words]:
        assert word in message


WRITTEN = {
    "an escape that TOML has not": (
        r'file = "C:\Users\me\dress.obj"',
        '"C:\\Users\\me\\dress.obj"; a backslash in double quotes begins a sign: write "C:/Users/me/dress.obj", or',
    ),
    "an escape that it has": (r'file = "C:\temp\new.obj"', "garment.file: a text without tabs"),
    "in a list": (r'mesh = ["Dress", "a\b"]', "garment.mesh[1]: a text without tabs"),
    "no quotes": ("file = dress.obj  # mine", 'text stands in quotes: file = "dress.obj"'),
    "a comma": ("weld = 0,002  # 2 mm", "a number has a point, no comma: weld = 0.002"),
    "something else": ("file = [", "correct that line"),
}


@pytest.mark.parametrize("case", WRITTEN)
def test_what_is_not_toml_shows_its_line_and_the_usual_mend(tmp_path, case):
    line, words = WRITTEN[case]
    with pytest.raises(InputError) as raised:
        load_scene(write(tmp_path, f"[garment]\n{line}\n"))
    assert words in str(raised.value) and "scene.toml" in str(raised.value)


@pytest.mark.parametrize("line", [r"file = 'C:\Users\me\dress.obj'", r'file = "C:\\Users\\me\\dress.obj"'])
def test_paths_of_windows_in_single_quotes_or_with_two_backslashes(tmp_path, line):
    """Also where an editor puts its mark before the first line."""
    assert load_scene(write(tmp_path, f"\ufeff[garment]\n{line}\n")).garment.file == r"C:\Users\me\dress.obj"


def test_missing_files(tmp_path):
    with pytest.raises(InputError, match="no such scene file"):
        load_scene(tmp_path / "none.toml")
    with pytest.raises(InputError, match="ncs:demo"):
        load_scene("ncs:nothing")


@pytest.mark.parametrize(
    ("changes", "cell"),
    [
        ({}, "swing"),
        ({"motion": {"fps": 15}}, "gated"),
        ({"motion": {"fps": 15.1}}, "swing"),
        ({"physics": {"inertia": False}}, "gated"),
        ({"network": {"method": "snug"}}, "gated"),
        ({"body": {"file": "none"}}, "gated"),  # it hangs on nothing
        ({"body": {"file": "none"}, "garment": {"pins": "waist"}}, "swing"),
        ({"body": {"file": "none"}, "garment": {"pins": "waist"}, "physics": {"pinning": {"stiffness": 0}}}, "gated"),
        ({"physics": {"collision": {"stiffness": 0}}}, "gated"),
        ({"network": {"cell": "linear"}}, "linear"),
    ],
)
def test_the_default_cell_is_what_the_scene_can_be_trained_with(changes, cell):
    found = with_cell(scene_from(changes))
    assert found.network.cell == cell
    assert with_cell(scene_from(found.to_dict())) == scene_from(found.to_dict())  # as a run keeps it


@pytest.mark.parametrize(
    ("name", "found"), [("dress.npz", r"a \.npz"), ("folder", "a folder"), ("dress", "a file without suffix")]
)
def test_what_is_no_scene_file_is_said_to_be_none(tmp_path, name, found):
    """A garment or a run in a scene's place is no broken TOML."""
    (tmp_path / name).mkdir() if name == "folder" else (tmp_path / name).write_bytes(b"\x93")
    with pytest.raises(InputError, match=rf"ends in \.toml expected \(found '{found}'\).*ncs fit writes one"):
        load_scene(tmp_path / name)
