"""Models (robot.xml) that are cut off, leave their folder, fill memory, or hold no numbers."""

import os
import struct

from case import Case, put, swap
from one_joint_arm import ARM

LEAVES = "inside the folder of system.yaml"
SECRET = "<mujoco><worldbody><geom name='secret' size='1'/></worldbody></mujoco>"  # ../secret.xml


def xml(name, content, said, **others):
    """Return a case whose robot.xml is ``content``, with other files by their names."""

    def spoil(folder):
        for file, data in others.items():
            path = folder / file.replace("_", "/").replace("/xml", ".xml").replace("/stl", ".stl")
            path.parent.mkdir(exist_ok=True)
            path.write_text(data)
        put(content, file="robot.xml")(folder)

    return Case(name=f"XML {name}", spoil=spoil, said=said)


def inside(more, place="<worldbody>"):
    """Return the arm's model with more before a place."""
    return ARM.replace(place, more + place, 1)


def cut_off():
    for count in range(0, len(ARM.rstrip()), 23):
        yield xml(f"cut at {count}", ARM[:count], "XML in robot.xml")


def leaving():
    """Refer to files that are outside."""
    parts = {
        "include": '<include file="../secret.xml"/>',
        "include twice removed": '<include file="../../secret.xml"/>',
        "absolute include": '<include file="/etc/passwd"/>',
        "roundabout include": '<include file="logs/../../secret.xml"/>',
        "spelt include": '<include file="&#46;&#46;/secret.xml"/>',
        "mesh": '<asset><mesh name="m" file="../secret.stl"/></asset>',
        "absolute mesh": '<asset><mesh name="m" file="/etc/hostname"/></asset>',
        "hfield": '<asset><hfield name="h" file="../secret.png" size="1 1 1 1"/></asset>',
        "texture": '<asset><texture name="t" type="2d" file="../secret.png"/></asset>',
        "texture of a cube": '<asset><texture name="t" fileup="../secret.png"/></asset>',
        "skin": '<deformable><skin name="s" file="../secret.skn"/></deformable>',
        "model": '<asset><model name="a" file="../secret.xml"/></asset>',
        "meshdir": '<compiler meshdir=".."/><asset><mesh file="secret.stl"/></asset>',
        "absolute meshdir": '<compiler meshdir="/etc"/><asset><mesh file="hostname"/></asset>',
        "texturedir": '<compiler texturedir=".."/><asset><texture file="secret.png"/></asset>',
        "assetdir": '<compiler assetdir=".."/><asset><mesh file="secret.stl"/></asset>',
        "dirs that add up": (
            '<compiler assetdir="logs" meshdir="../.."/><asset><mesh file="secret.stl"/></asset>'
        ),
    }  # fmt: skip
    for name, part in parts.items():
        yield xml(f"{name} that leaves", inside(part), LEAVES)
    flex = '<flexcomp name="f" type="gmsh" file="../secret.msh"/>'
    yield xml("flexcomp that leaves", ARM.replace("<geom", f"{flex}<geom", 1), LEAVES)
    plugin = '<extension><plugin plugin="mujoco.sdf.gear"><instance name="i"><config key="path" value="../secret"/></instance></plugin></extension>'  # noqa: E501
    yield xml("plugin that leaves", inside(plugin), LEAVES)
    own = '<mujoco><include file="../secret.xml"/></mujoco>'
    yield xml(
        "include that leaves later", inside('<include file="part.xml"/>'), LEAVES, part_xml=own
    )
    deep = '<mujoco><include file="../../secret.xml"/></mujoco>'
    first = inside('<include file="sub/part.xml"/>')
    yield xml("include that leaves deeper", first, LEAVES, sub_part_xml=deep)
    folder = '<mujoco><compiler meshdir=".."/></mujoco>'
    mesh = inside('<include file="part.xml"/><asset><mesh file="secret.stl"/></asset>')
    yield xml("meshdir of an include that leaves", mesh, LEAVES, part_xml=folder)
    attached = inside('<asset><model name="a" file="part.xml"/></asset>')
    own = '<mujoco><asset><mesh file="../secret.stl"/></asset><worldbody/></mujoco>'
    yield xml("mesh of a model that leaves", attached, LEAVES, part_xml=own)


def links():
    """Leave by links, or refer to what is no file."""
    part = inside('<include file="part.xml"/>')
    mesh = inside('<asset><mesh name="m" file="part.xml"/></asset>')
    things = {
        "a link out": (lambda p: p.symlink_to("../secret.xml"), LEAVES),
        "a link to a device": (lambda p: p.symlink_to("/dev/zero"), LEAVES),
        "a pipe": (os.mkfifo, "a file that exists"),
        "a folder": (lambda p: p.mkdir(), "a file that exists"),
        "nothing": (lambda p: None, "part.xml"),
    }
    for name, (make, said) in things.items():
        for kind, model in ("an include", part), ("a mesh", mesh):
            spoil = lambda f, make=make, model=model: (
                make(f / "part.xml"), (f / "robot.xml").write_text(model)
            )  # fmt: skip
            yield Case(name=f"XML {name} as {kind}", spoil=spoil, said=said)
    link = lambda f: ((f / "robot.xml").unlink(), (f / "robot.xml").symlink_to("../secret.xml"))
    yield Case(name="XML is a link out", spoil=link, said=LEAVES)
    pipe = lambda f: ((f / "robot.xml").unlink(), os.mkfifo(f / "robot.xml"))
    yield Case(name="XML is a pipe", spoil=pipe, said="a file that exists")


def entities():
    """Declare entities: MuJoCo has none."""
    laughs = '<!ENTITY a0 "ha">' + "".join(
        f'<!ENTITY a{i} "' + f"&a{i - 1};" * 10 + '">' for i in range(1, 12)
    )
    letters = "x" * 100_000
    declared = {
        "external entity": '<!ENTITY x SYSTEM "file:///etc/passwd">',
        "external entity near": '<!ENTITY x SYSTEM "../secret.xml">',
        "external entity far": '<!ENTITY x SYSTEM "http://127.0.0.1:9/x">',
        "parameter entity": '<!ENTITY % x SYSTEM "file:///etc/passwd"> %x;',
        "billion laughs": laughs,
        "quadratic blowup": f'<!ENTITY x "{letters}">',
        "attributes by default": '<!ATTLIST geom mass CDATA "7">',
    }
    for name, inner in declared.items():
        used = "&a11;" if "laughs" in name else "&x;" if inner.startswith("<!ENTITY x") else ""
        content = f"<!DOCTYPE mujoco [{inner}]>{ARM.strip().replace('link', f'link{used}', 1)}"
        yield xml(name, content, "a document type")
    outer = f'<!DOCTYPE mujoco SYSTEM "../secret.dtd">{ARM.strip()}'
    yield xml("external document type", outer, "a document type")


def namespaces():
    """Name elements so that only MuJoCo, which ignores namespaces, takes them for its own."""
    own = '<mujoco><include file="../secret.xml"/></mujoco>'
    named = inside('<include xmlns="x" file="part.xml"/>')
    yield xml("include in a namespace", named, "a namespace", part_xml=own)
    plain = inside('<include file="part.xml"/>')
    root = '<mujoco xmlns="x"><include file="other.xml"/></mujoco>'
    yield xml("part in a namespace", plain, "a namespace", part_xml=root, other_xml=own)
    prefixed = inside('<include xmlns:y="x" file="part.xml"/>')
    yield xml("prefix of a namespace", prefixed, "a namespace", part_xml=own)
    many = '<replicate xmlns="x" count="3000"><replicate count="50"><geom size=".1"/></replicate></replicate>'  # noqa: E501
    yield xml("bomb in a namespace", inside(many, "<body"), "a namespace")


def backslashes():
    """Name folders with a letter that MuJoCo takes for their separator."""
    said = "names of files with / between folders"
    parts = {
        "include": '<include file="..\\secret.xml"/>',
        "include from within": '<include file="logs\\..\\..\\secret.xml"/>',
        "include of its own": '<include file=".\\part.xml"/>',
        "mesh": '<asset><mesh name="m" file="..\\secret.obj"/></asset>',
        "folder of meshes": '<compiler meshdir="..\\"/>',
        "model": '<asset><model name="m" file="..\\secret.xml"/></asset>',
        "model of itself": '<asset><model name="m" file="logs\\..\\robot.xml"/></asset>',
    }
    for name, part in parts.items():
        yield xml(f"{name} by backslashes", inside(part), said, part_xml="<mujoco/>")


def broken():
    """Write XML that is none, or none of MuJoCo's."""
    contents = {
        "of an unknown element": (inside("<magic/>"), "compiles"),
        "of an unknown attribute": (ARM.replace("mass=", "weight="), "compiles"),
        "of nothing": ("", "XML in robot.xml"),
        "of an empty model": ("<mujoco/>", "a body, got 'link'"),
        "of another root": ("<robot><a/></robot>", "a body, got 'link'"),
        "of HTML": ("<!doctype html><p>404", "XML in robot.xml"),
        "of YAML": ("worldbody: {}", "XML in robot.xml"),
        "in UTF-16": (ARM.encode("utf-16"), "robot.xml"),
        "in Latin-1": (ARM.replace("link", "lînk").encode("latin-1"), "XML in robot.xml"),
        "in no encoding": (f'<?xml version="1.0" encoding="x-mars"?>{ARM.strip()}', "XML in robot"),
        "with NUL": (ARM.replace("link", "li\0nk"), "XML in robot.xml"),
        "with two roots": (ARM + ARM, "XML in robot.xml"),
        "of deep nesting": ("<mujoco><worldbody>" + "<body>" * 50_000, "XML in robot.xml"),
        "of deep closed nesting": (
            f"<mujoco><worldbody>{'<body>' * 5000}{'</body>' * 5000}</worldbody></mujoco>",
            "compiles",
        ),
        "without a joint": (
            ARM.replace('<joint name="hinge" axis="0 1 0" damping="0.02"/>', ""),
            "'hinge'",
        ),
        "without mass": (ARM.replace('mass=".5"', 'mass="0"'), "compiles"),
        "of negative mass": (ARM.replace('mass=".5"', 'mass="-1"'), "compiles"),
        "of an unknown joint": (ARM.replace('joint="hinge"', 'joint="elbow"'), "compiles"),
        "of mass in words": (ARM.replace('mass=".5"', 'mass="heavy"'), "compiles"),
        "without a time step": (ARM.replace('"0.005"', '"0"'), "time step"),
        "of a negative time step": (ARM.replace('"0.005"', '"-0.005"'), "time step"),
        "that includes itself": (inside('<include file="robot.xml"/>'), "included once"),
        "that is its own part": (
            inside('<asset><model name="a" file="robot.xml"/></asset>'),
            "itself",
        ),
    }
    for name, (content, said) in contents.items():
        yield xml(name, content, said)
    part = '<mujoco><asset><model name="b" file="robot.xml"/></asset><worldbody/></mujoco>'
    circle = inside('<asset><model name="a" file="part.xml"/></asset>')
    yield xml("in a circle", circle, "itself", part_xml=part)
    for name, old in ("mass", ".5"), ("timestep", "0.005"), ("damping", "0.02"), ("size", ".02"):
        for value in "nan", "inf", "1e300":
            spoil = swap(f'{name}="{old}"', f'{name}="{value}"', file="robot.xml")
            yield Case(name=f"XML of {name} {value}", spoil=spoil, said="robot.xml")
    nowhere = swap('<body name="link"', '<body name="link" pos="nan 0 0"', file="robot.xml")
    yield Case(name="XML of a place NaN", spoil=nowhere, said="robot.xml")


def endless():
    """Ask for simulations that would not end."""
    step = swap('timestep="0.005"', 'timestep="1e-12"', file="robot.xml")
    yield Case(name="XML of tiny steps", spoil=step, said="at most 10000 time steps in a control")
    for name in "iterations", "ls_iterations", "noslip_iterations", "ccd_iterations":
        endless = swap("<option", f'<option {name}="1000000000"', file="robot.xml")
        said = f"{name} of at most 10000 in the <option> of robot.xml, got 1000000000"
        yield Case(name=f"XML of many {name}", spoil=endless, said=said)


def bombs():
    """Ask for more than a machine has."""
    body = "<geom size='.1'/>"
    parts = {
        "copies": f'<replicate count="100000000" offset="1 0 0">{body}</replicate>',
        "copies of copies": '<replicate count="1000">' * 4 + body + "</replicate>" * 4,
        "a chain": '<composite type="cable" prefix="c" count="1000000 1 1" size="1">'
        '<geom type="capsule" size=".01"/></composite>',
        "a soft block": '<flexcomp name="f" type="grid" count="1000 1000 1000" dim="3"/>',
    }
    for name, part in parts.items():
        yield xml(f"of too many: {name}", ARM.replace("<body", f"{part}<body", 1), "at most")
    sections = {
        "hfield": '<asset><hfield name="h" nrow="100000" ncol="100000" size="1 1 1 1"/></asset>',
        "texture": '<asset><texture name="t" builtin="flat" width="9000" height="90000"/></asset>',
        "hfields": "<asset>"
        + "".join(
            f'<hfield name="h{i}" nrow="10000" ncol="9000" size="1 1 1 1"/>' for i in range(4)
        )
        + "</asset>",
        "sphere": '<asset><mesh name="m" builtin="supersphere" params="30000 1 1"/></asset>',
        "ring": '<asset><mesh name="m" builtin="supertorus" params="9000 .5 1 1"/></asset>',
        "readings": '<sensor><user dim="100000000"/></sensor>',
        "activations": '<actuator><general joint="hinge" actdim="100000000"/></actuator>',
        "memory": '<size memory="1000G"/>',
        "user data": '<size nuserdata="2000000000"/>',
        "keys": '<size nkey="50000"/>',
        "contacts": '<size njmax="2000000000" nconmax="2000000000"/>',
    }  # fmt: skip
    for name, part in sections.items():
        yield xml(f"of too much: {name}", inside(part), "at most")
    floor = '<worldbody><geom type="plane" size="1 1 1" pos="0 0 -.4"/>'
    box = '<body pos="0 0 .5"><freejoint/><geom type="box" size=".3 .3 .3" mass="1"/></body>'
    for size, boxes, said in (("1K", 0, "enough <size memory>"), ("100K", 6, "room for all")):
        first = f'<size memory="{size}"/>{floor}{boxes * box}'
        yield xml(f"of {size} of memory", ARM.replace("<worldbody>", first, 1), said)
    attach = "".join(f'<attach model="m" prefix="p{i}"/>' for i in range(9))
    model = '<mujoco><asset><model name="m" file="{}"/></asset><worldbody>{}</worldbody></mujoco>'
    parts = {f"part{i}_xml": model.format(f"part{i + 1}.xml", attach) for i in range(7)}
    parts["part7_xml"] = f"<mujoco><worldbody>{body}</worldbody></mujoco>"
    first = inside('<asset><model name="m" file="part0.xml"/></asset>').replace(
        "<body", f"{attach}<body", 1
    )
    yield xml("of models of models", first, "at most", **parts)
    texture = inside('<asset><texture name="t" type="2d" file="big.png"/></asset>')

    def picture(folder):
        header = struct.pack(">IIBBBBB", 200_000, 200_000, 8, 6, 0, 0, 0)
        (folder / "big.png").write_bytes(b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + header)
        (folder / "robot.xml").write_text(texture)

    yield Case(name="XML of a huge picture", spoil=picture, said="at most")


CASES = [
    *cut_off(),
    *leaving(),
    *links(),
    *entities(),
    *namespaces(),
    *backslashes(),
    *broken(),
    *endless(),
    *bombs(),
]
