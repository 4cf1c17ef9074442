"""python -m tests.fuzz: run thousands of random scenes and write what was found as scripts that can be pasted."""

import argparse
import json
import os
import subprocess
import sys
import time

from .campaign import campaign


def main() -> int:
    """Run scenes in child processes, so that a crash ends only one structure."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--scenes", type=int, default=2000)
    parser.add_argument("--each", type=int, default=20, help="scenes of a structure")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--batch", type=int, default=20, help="structures of a process")
    parser.add_argument("--folder", default="fuzz-finds", help="for scripts")
    parser.add_argument("--kinds", default="", help="of finds to look for, separated by commas; all by default")
    parser.add_argument("--part", default="", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.part:
        begin, end = map(int, args.part.split(":"))
        for line in campaign(args.seed, begin, end, args.each, args.folder, set(args.kinds.split(",")) if args.kinds else None):
            print(json.dumps(line), flush=True)
        return 0
    os.makedirs(args.folder, exist_ok=True)
    return parent(args)


def parent(args) -> int:
    """Distribute structures among child processes, and sum up their results."""
    count, clock = -(-args.scenes // args.each), time.time()
    todo = [(k, min(k + args.batch, count)) for k in range(0, count, args.batch)]
    running, total, finds = {}, {"scenes": 0, "frames": 0, "refused": 0, "structures": 0}, []

    def start(begin, end):
        command = [sys.executable, "-m", "tests.fuzz", "--part", f"{begin}:{end}", "--seed", str(args.seed)]
        command += ["--each", str(args.each), "--folder", args.folder, "--kinds", args.kinds]
        running[subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)] = (begin, end)

    while todo or running:
        while todo and len(running) < args.processes:
            start(*todo.pop(0))
        child = next(iter(running))
        begin, end = running.pop(child)
        done = begin
        for raw in child.stdout:
            if not raw.startswith("{"):
                continue
            line = json.loads(raw)
            if "begins" in line:
                done = line["begins"]
                continue
            for k in total:
                total[k] += line.get(k, 0)
            for find in line.get("finds", []):
                finds.append(find)
                says = f"{find['kind']} in structure {find['structure']}: {find['says'][:160]!r}"
                print(f"[{time.time() - clock:6.0f} s] {says}\n    {find['script']}", flush=True)
        errors = child.stderr.read()
        if child.wait():
            finds.append({"kind": "crash", "structure": done, "says": errors[-300:], "script": ""})
            print(f"crash (status {child.returncode}) in structure {done}: {errors[-1500:]}", flush=True)
            if done + 1 < end:
                todo.insert(0, (done + 1, end))
    kinds = {}
    for find in finds:
        kinds[find["kind"]] = kinds.get(find["kind"], 0) + 1
    took, what = f"{time.time() - clock:.0f} s", kinds or "none"
    print(", ".join(f"{count} {name}" for name, count in total.items()), f"in {took}; finds: {what}")
    return 1 if finds else 0


if __name__ == "__main__":
    sys.exit(main())
