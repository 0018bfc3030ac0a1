"""Descriptions (robot.yaml) that are cut off, hostile or wrong, and odd arguments."""

import os

from case import Case, put, swap
from one_joint_arm import SYSTEM


def yaml(name, content, said):
    return Case(name=f"YAML {name}", spoil=put(content, file="robot.yaml"), said=said)


def cut_off():
    """Cut the description at every seventh byte that leaves it unfinished."""
    whole = [SYSTEM.index("\nparameters:") + i for i in (0, 1)]
    whole += [SYSTEM.index("\nnoise:") + i for i in (0, 1)]
    for count in range(0, len(SYSTEM) - 2, 7):
        if count not in whole:
            yield yaml(f"cut at {count}", SYSTEM[:count], "expected")


def hostile():
    """Try to run, to reach, to fill memory, to nest, to repeat."""
    touch = "'touch executed'"
    tags = {
        "apply": f"!!python/object/apply:os.system [{touch}]",
        "new": f"!!python/object/new:os.system [{touch}]",
        "name": "!!python/name:os.system",
        "module": "!!python/module:os",
        "object": "!!python/object:os.PathLike {}",
        "binary": "!!binary aGVsbG8=",
        "float": "!!float x",
        "int": "!!int 1:1:1",
        "timestamp": "!!timestamp 2020-99-99",
        "null": "!!null ''",
        "set": "!!set {a, b}",
        "own": "!robot x",
    }
    for name, value in tags.items():
        yield yaml(f"tag {name}", f"simulator: {value}{SYSTEM[22:]}", "expected")
        yield yaml(f"tag {name} for all", value, "expected")
    laughs = "a0: &a0 [x, x]\n" + "".join(
        f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 12)
    )
    contents = {
        "billion laughs": (laughs, "plain YAML"),
        "a merge": (f"<<: {{noise: {{q: 1}}}}\n{SYSTEM}", "'<<'"),
        "an alias of itself": ("a: &a [*a]", "plain YAML"),
        "deep lists": ("[" * 100_000, "plain YAML"),
        "deep mappings": ("{a: " * 20_000, "plain YAML"),
        "deep blocks": ("".join(" " * i + "a:\n" for i in range(400)), "robot.yaml"),
        "thousands of keys": (
            SYSTEM.replace("noise: {", "noise: {" + "".join(f"k{i}: 1, " for i in range(8_000))),
            "more than 5000 keys and values",
        ),
        "a list of thousands": (
            f"{SYSTEM}effects: [{', '.join(f'{i:x}' for i in range(16_000))}]",
            "more than 5000 keys and values",
        ),
        "hundreds of keys": (
            SYSTEM.replace("noise: {", "noise: {" + "".join(f"k{i}: 1, " for i in range(800))),
            "a channel in noise",
        ),
        "megabytes": ("#" * 5_000_000, "100 kB"),
        "tabs": (SYSTEM.replace("  ", "\t"), "plain YAML"),
        "a list": ("- simulator: robot.xml", "a mapping"),
        "a word": ("robot", "a mapping"),
        "a number": ("7", "a mapping"),
        "nothing": ("", "text under 'simulator'"),
        "comments": ("# robot\n", "text under 'simulator'"),
        "two documents": (f"{SYSTEM}---\n{SYSTEM}", "plain YAML"),
        "two keys": (f"{SYSTEM}control_dt: 0.02\n", "'control_dt' twice"),
        "two joints": (SYSTEM.replace("{hinge: q}", "{hinge: q, hinge: p}"), "'hinge' twice"),
        "JSON that is cut": ('{"simulator": "robot.xml", "control_dt"', "plain YAML"),
        "XML": ("<robot/>", "a mapping"),
        "a list as a key": ("? [a, b]\n: c\n", "plain YAML"),
        "a mapping as a key": ("? {a: b}\n: c\n", "plain YAML"),
        "control characters": (SYSTEM + "\x07", "plain YAML"),
        "NUL": (SYSTEM + "\0", "plain YAML"),
        "UTF-16": (SYSTEM.encode("utf-16"), "YAML in UTF-8"),
        "Latin-1": (SYSTEM.encode() + b"# \xe9t\xe9", "YAML in UTF-8"),
        "a surrogate": (SYSTEM + '"\\ud800": 1\n', "\\ud800"),
    }
    for name, (content, said) in contents.items():
        yield yaml(name, content, said)


def values():
    """Put values that mean nothing where names, numbers and bounds are expected."""
    changes = {
        "reversed bounds": ("[0.3, 0.8]", "[0.8, 0.3]", "low < high"),
        "equal bounds": ("[0.3, 0.8]", "[0.3, 0.3]", "low < high"),
        "bounds of NaN": ("[0.3, 0.8]", "[nan, 0.8]", "finite bounds"),
        "bounds of infinity": ("[0.3, 0.8]", "[0.3, .inf]", "a number under"),
        "infinite bounds": ("[0.3, 0.8]", "[0.3, inf]", "finite bounds"),
        "huge bounds": ("[0.3, 0.8]", "[0.3, 1e300]", "finite bounds"),
        "three bounds": ("[0.3, 0.8]", "[0.3, 0.5, 0.8]", "2 numbers"),
        "bounds in words": ("[0.3, 0.8]", "[light, heavy]", "a number under"),
        "one bound": ("[0.3, 0.8]", "0.5", "2 numbers"),
        "negative mass": ("[0.3, 0.8]", "[-0.8, -0.3]", "body_mass"),
        "bounds of a list": ("[0.3, 0.8]", "[[0.3], 0.8]", "a number under"),
        "an unknown field": ("body_mass[link]", "body_weight[link]", "body_weight"),
        "the time step": ("body_mass[link]", "opt.timestep", "got 'opt.timestep'"),
        "a mass of no body": ("body_mass[link]", "body_mass[hand]", "a body, got 'hand'"),
        "no entry": ("body_mass[link]", "mass", "mass"),
        "an open bracket": ("body_mass[link]", "'body_mass[link'", "body_mass[link"),
        "an empty entry": ("body_mass[link]", "'body_mass[]'", "body_mass[]"),
        "a number of no body": ("body_mass[link]", "body_mass[99]", "99"),
        "code for an entry": ("body_mass[link]", "'__class__[0]'", "__class__"),
        "the mass of the world": ("body_mass[link]", "body_mass[world]", "a nominal mass"),
        "nothing uncertain": ("  body_mass[link]: [0.3, 0.8]\n", "", "something in"),
        "no bounds": ("[0.3, 0.8]", "{entries: ['body_mass[link]']}", "2 numbers"),
        "no entries": ("[0.3, 0.8]", "{bounds: [0.3, 0.8]}", "names under 'entries'"),
        "logarithm from 0": (
            "[0.3, 0.8]",
            "{entries: ['body_mass[link]'], bounds: [0, 1], log: true}",
            "log",
        ),
        "one entry twice": (
            "noise:",
            "  m: {entries: ['body_mass[link]', 'body_mass[link]'], bounds: [0.3, 0.8]}\nnoise:",
            "in one parameter",
        ),
        "an unknown joint": ("{hinge: q}", "{elbow: q}", "a joint in columns.qpos, got 'elbow'"),
        "a joint by number": ("{hinge: q}", "{0: q}", "a joint in columns.qpos, got '0'"),
        "a column in a mapping": ("{hinge: q}", "{hinge: {a: q}}", "names under 'hinge'"),
        "no column": ("{hinge: q}", "{hinge: }", "names under 'hinge'"),
        "no positions": ("{hinge: q}", "{}", "at least one joint's position"),
        "columns as a list": ("{hinge: q}", "[q]", "a mapping"),
        "two columns": ("{hinge: q}", "{hinge: [q, p]}", "1 column(s) for joint 'hinge'"),
        "one column for two": ("{hinge: qd}", "{hinge: q}", "each column once, got 'q'"),
        "an unknown actuator": ("{motor: tau}", "{engine: tau}", "an actuator in columns.ctrl"),
        "no actuator": ("{motor: tau}", "{}", "a column for every actuator"),
        "two columns of an actuator": ("{motor: tau}", "{motor: [tau, u]}", "text under 'motor'"),
        "time as a list": ("time: t", "time: [t]", "text under 'time'"),
        "an unknown column": ("time: t", "time: seconds", "a column of run0.csv, got 'seconds'"),
        "an unknown kind of column": ("  qvel:", "  qacc:", "a key of robot.yaml: columns"),
        "an unknown key": ("control_dt:", "controldt:", "control_dt (did you mean this?)"),
        "another key": ("noise:", "plugin: os\nnoise:", "a key of robot.yaml, got 'plugin'"),
        "noise of no channel": ("{q: 0.001", "{x: 0.001", "a channel in noise, got 'x'"),
        "negative noise": ("{q: 0.001", "{q: -0.001", "standard deviation of q"),
        "noise of NaN": ("{q: 0.001", "{q: nan", "standard deviation of q"),
        "huge noise": ("{q: 0.001", "{q: 1e300", "standard deviation of q"),
        "infinite noise": ("{q: 0.001", "{q: inf", "standard deviation of q"),
        "noise in words": ("{q: 0.001", "{q: small", "a number under 'q'"),
        "noise as a number": ("{q: 0.001, qd: 0.02}", "0.001", "a mapping"),
        "an unknown effect": ("noise:", "effects: [magic]\nnoise:", "an effect of the catalogue"),
        "effects as a mapping": ("noise:", "effects: {a: b}\nnoise:", "names under 'effects'"),
        "no effects": ("noise:", "effects: []\nnoise:", "effects"),
        "an effect of nothing": ("noise:", "effects: ['']\nnoise:", "names under 'effects'"),
        "an effect twice": (
            "noise:", "effects: [payload, payload]\nnoise:", "each effect once, got 'payload'",
        ),
    }  # fmt: skip
    for step in "0", "-0.01", "nan", "inf", "1e300", "0.0125", "1e-300", "ten", "[0.01]", "1_0":
        changes[f"a step of {step}"] = ("control_dt: 0.01", f"control_dt: {step}", "control_dt")
    arguments = {"an unknown effect", "effects as a mapping", "no effects", "an effect of nothing",
                 "an effect twice"}  # fmt: skip
    for name, (old, new, said) in changes.items():
        own = ("effects=",) if name in arguments else ()
        yield Case(name=f"YAML with {name}", spoil=swap(old, new), said=said, arguments=own)


def simulators():
    """Name simulators that do not exist, or files elsewhere."""
    names = {
        "../secret.xml": "inside the folder",
        "../../../../etc/passwd": "inside the folder",
        "/etc/passwd": "inside the folder",
        "./logs/../../secret.xml": "inside the folder",
        "~/robot.xml": "a file that exists",
        "logs": "a file that exists",
        ".": "a file that exists",
        "robots.xml": "robot.xml (did you mean this?)",
        "'robot.xml\\0'": "robot.xml",
        '"robot.xml\\0.txt"': "robot.xml",
        "robot.yaml": "XML in robot.yaml",
        "logs/run0.csv": "XML in run0.csv",
        "'gymnasium:'": "a known task",
        "gymnasium:Hoper-v5": "Hopper-v5 (did you mean this?)",
        "gymnasium:os:Env-v0": "a known task",
        "gymnasium:CartPole-v1": "a known task",
        "gymnasium:../secret": "a known task",
        "'dm_control:'": "a task of the control suite",
        "dm_control:cartpole": "a task of the control suite",
        "dm_control:os/system": "a task of the control suite",
        "python:os.system": "an MJCF file, gymnasium:NAME or dm_control",
        "http://example.org/robot.xml": "an MJCF file, gymnasium:NAME or dm_control",
        "file:///etc/passwd": "an MJCF file, gymnasium:NAME or dm_control",
        "[robot.xml]": "text under 'simulator'",
        "{a: b}": "text under 'simulator'",
        "''": "text under 'simulator'",
        "x" * 5000: "a file",
    }
    for name, said in names.items():
        spoil = swap("robot.xml", name, count=1)
        yield Case(name=f"simulator {name[:40]}", spoil=spoil, said=said)


def no_files():
    """Put what is no file in place of the description, or of the report."""

    def described(make):
        return lambda folder: ((folder / "robot.yaml").unlink(), make(folder / "robot.yaml"))

    things = {
        "a folder": lambda p: p.mkdir(),
        "a pipe": os.mkfifo,
        "a device": lambda p: p.symlink_to("/dev/zero"),
        "a link to itself": lambda p: p.symlink_to(p.name),
        "nothing": lambda p: None,
        "unreadable": lambda p: p.symlink_to("/proc/self/mem"),
    }
    for name, make in things.items():
        yield Case(name=f"YAML is {name}", spoil=described(make), said="robot.yaml")


def arguments():
    """Give arguments that mean nothing."""
    given = {
        "seed=x": "seed", "horizon=1.5": "horizon", "horizon=-3": "a horizon of 1 or more",
        "horizon=" + "9" * 400: "a horizon of at most",
        "threads=0": "threads from 1 to 1024", "threads=" + "9" * 12: "threads from 1 to 1024",
        "seed=-1": "seed", "seed=" + "9" * 30: "seed",
        "progress=perhaps": "progress", "debug=perhaps": "debug",
        "out=robot.yaml": "robot.yaml", "out=robot.yaml/deep": "robot.yaml",
        "out=/proc/nowhere": "/proc/nowhere", "out=/dev/full": "/dev/full",
        "data=[logs": "data", "data={a: b}": "data", "data=[a,b]": "data", "data=???": "data",
        "data=${oc.env:NOWHERE}": "NOWHERE", "data=${data}": "data",
        "system=!!python/object/apply:os.system ['touch executed']": "system",
        "effects=','": "each effect once", "effects=payload,payload": "each effect once",
        "leave_out=','": "beside those left out", "verbose=true": "the name of a setting",
        "--help": "of the form key=value", "data": "of the form key=value",
        "data=\udcff": "data", "data=a\0b": "data",
        "data=" + "x" * 5000: "a folder or file of logs",
    }  # fmt: skip
    for argument, said in given.items():
        name = f"argument {argument[:40]}".encode("unicode_escape").decode()
        yield Case(name=name, arguments=(argument,), said=said)


CASES = [*cut_off(), *hostile(), *values(), *simulators(), *no_files(), *arguments()]
