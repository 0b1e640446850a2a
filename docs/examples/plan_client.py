"""Ask ``pickplace-serve`` for a plan; needs nothing but Python."""

import json
import os
import sys
import urllib.error
import urllib.request


def plan(request: dict, url: str = "http://127.0.0.1:8000") -> dict:
    """Return the answer to a request; an answer without a plan has the key ``error``."""
    headers = {"Content-Type": "application/json"}
    if token := os.environ.get("PICKPLACE_TOKEN"):
        headers["Authorization"] = f"Bearer {token}"
    call = urllib.request.Request(f"{url}/plan", json.dumps(request).encode(), headers)
    try:
        with urllib.request.urlopen(call, timeout=30) as reply:
            return json.load(reply)
    except urllib.error.HTTPError as error:  # 4xx: the body says why in one sentence
        try:
            return json.load(error)
        except ValueError:  # not of the service: of a proxy, or of another program at this address
            return {"error": f"{url}: {error}, and no JSON; expected the address of pickplace-serve."}


if __name__ == "__main__":
    item = {"x": 0.1, "y": 0.12, "w": 0.09, "d": 0.04, "h": 0.05, "yaw": 20}
    answer = plan({"items": [item], "tote_depth": [[0.25] * 6] * 6, "cell_size": 0.05}, *sys.argv[1:])
    sys.stdout.write(json.dumps(answer, indent=1) + "\n")
