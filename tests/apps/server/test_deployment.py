"""The container files. What a build would show, this machine cannot; what a linter shows, it can."""

from __future__ import annotations

import inspect
import itertools
import json
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import kubernetes_validate
import promql_parser
import pytest
import yaml
from starlette.testclient import TestClient

from tests.apps.server.conftest import MakeApp
from tests.test_readme import lines
from trilitenet.apps.cli import _repeated, build_app
from trilitenet.apps.server.command import serve
from trilitenet.apps.server.metrics import Metrics
from trilitenet.apps.server.settings import Settings

ROOT = Path(__file__).resolve().parents[3]


def _yaml(path: str) -> list[Any]:
    return list(yaml.safe_load_all((ROOT / path).read_text(encoding="utf-8")))


def _program(name: str) -> str:
    path = shutil.which(name, path=str(Path(sys.executable).parent)) or shutil.which(name)
    if path is None:
        pytest.skip(f"{name} is not installed")
    return path


def test_the_dockerfile_has_no_faults() -> None:
    found = subprocess.run([_program("hadolint"), ROOT / "Dockerfile"], capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stdout


def test_the_image_is_slim_not_root_and_watched() -> None:
    text = (ROOT / "Dockerfile").read_text(encoding="utf-8")
    last = text[text.rindex("FROM ") :]
    assert "ARG PYTHON=3.12-slim" in text
    assert re.search(r"^USER 10001:10001$", last, re.MULTILINE)
    assert last.index("USER") < last.index("ENTRYPOINT")
    assert "HEALTHCHECK" in last
    assert "/healthz" in last


def _words(instruction: str) -> list[str]:
    """Return the words of an instruction of the Dockerfile's last stage, the last of that name."""
    text = (ROOT / "Dockerfile").read_text(encoding="utf-8")
    words: list[str] = json.loads(re.findall(rf"^{instruction} (\[.*\])$", text, re.MULTILINE)[-1])
    return words


def test_models_that_the_documented_containers_serve_are_inside_them() -> None:
    runs = [shlex.split(line) for line in lines(ROOT / "docs" / "serving.md") if line.startswith("docker run")]
    models = []
    for words in runs:
        options, arguments = words[: words.index("trilitenet")], words[words.index("trilitenet") + 1 :]
        asked = [*_words("ENTRYPOINT"), *(arguments or _words("CMD"))][1:]
        bound = build_app(asked).parse_args(_repeated(asked), print_error=False, exit_on_error=False)[1]
        model = bound.arguments["model"]
        volumes = [value for name, value in itertools.pairwise(options) if name == "--volume"]
        assert [Path(volume.split(":")[1]) for volume in volumes] == [Path(model).parent] * ("/" in model)
        models.append(model)
    assert models == ["tiny", "/models/tiny.xml"]
    text = (ROOT / "compose.yaml").read_text(encoding="utf-8")
    service = yaml.safe_load(text.replace("# volumes:", "volumes:"))["services"]["trilitenet"]
    assert service["volumes"] == ["./models:/models:ro"]
    assert service["command"] == ["--model", "${TRILITENET_MODEL:-tiny}"]


def test_the_health_check_asks_the_port_that_is_served() -> None:
    text = (ROOT / "Dockerfile").read_text(encoding="utf-8")
    assert "--port" not in (*_words("ENTRYPOINT"), *_words("CMD"))
    port = inspect.signature(serve).parameters["port"].default
    assert f"http://127.0.0.1:{port}/healthz" in text
    assert f"EXPOSE {port}\n" in text


def test_the_containers_of_compose_can_do_little() -> None:
    (compose,) = _yaml("compose.yaml")
    assert set(compose["services"]) == {"trilitenet", "prometheus", "grafana"}
    for service in compose["services"].values():
        assert service["cap_drop"] == ["ALL"]
        assert service["security_opt"] == ["no-new-privileges:true"]
        assert all(port.startswith("127.0.0.1:") for port in service["ports"])
        for volume in service.get("volumes", []):
            source = volume.split(":")[0]
            assert not source.startswith("./") or (ROOT / source).exists()
    assert compose["services"]["trilitenet"]["read_only"] is True


def test_the_kubernetes_manifest_is_valid_and_safe() -> None:
    resources = {resource["kind"]: resource for resource in _yaml("kubernetes/trilitenet.yaml")}
    for resource in resources.values():
        kubernetes_validate.validate(resource, kubernetes_validate.latest_version(), strict=True)
    pod = resources["Deployment"]["spec"]["template"]["spec"]
    (container,) = pod["containers"]
    assert pod["securityContext"]["runAsNonRoot"] is True
    assert container["securityContext"]["readOnlyRootFilesystem"] is True
    assert container["readinessProbe"]["httpGet"]["path"] == container["startupProbe"]["httpGet"]["path"] == "/readyz"
    assert container["livenessProbe"]["httpGet"]["path"] == "/healthz"
    assert container["imagePullPolicy"] == "IfNotPresent"
    drain = float(container["args"][container["args"].index("--drain") + 1])
    assert pod["terminationGracePeriodSeconds"] > drain + 30


def test_the_kubernetes_job_does_every_shard_once() -> None:
    (job,) = _yaml("kubernetes/predict.yaml")
    kubernetes_validate.validate(job, kubernetes_validate.latest_version(), strict=True)
    pod = job["spec"]["template"]["spec"]
    (container,) = pod["containers"]
    assert container["securityContext"]["readOnlyRootFilesystem"] is True
    (shard,) = [word for word in container["args"] if "$(" in word]
    assert shard == f"$(SHARD)/{job['spec']['completions']}"
    words = [word.replace("$(SHARD)", "15") for word in (*container["command"], *container["args"])]
    assert words[0] == "trilitenet"
    build_app(words[1:]).parse_args(_repeated(words[1:]), print_error=False, exit_on_error=False)


def _expressions() -> list[str]:
    dashboard = json.loads((ROOT / "monitoring/grafana/dashboards/trilitenet.json").read_text(encoding="utf-8"))
    shown = [target["expr"] for panel in dashboard["panels"] for target in panel["targets"]]
    (alerts,) = _yaml("monitoring/alerts.yml")
    return shown + [rule["expr"] for group in alerts["groups"] for rule in group["rules"]]


def test_dashboard_and_alerts_ask_for_what_the_service_counts(make_app: MakeApp) -> None:
    metrics = make_app().service.metrics
    known = {"up"}
    for family in metrics.registry.collect():
        suffixes = {
            "counter": ["_total"],
            "histogram": ["_bucket", "_sum", "_count"],
        }.get(family.type, [""])
        known |= {family.name + suffix for suffix in suffixes}
    for expression in _expressions():
        promql_parser.parse(expression)
        names = set(re.findall(r"\b(?:trilitenet|process)_\w+|\bup\b", expression))
        assert names, expression
        assert names <= known, expression


def test_the_longest_request_that_the_limits_allow_has_a_bucket() -> None:
    metrics, limits = Metrics(), Settings()
    metrics.answer("/v1/predict", "POST", 200, limits.upload_timeout + limits.deadline + limits.answer_timeout)
    line = 'trilitenet_request_seconds_bucket{le="100.0",route="/v1/predict"} 1.0'
    assert line in metrics.text().decode().splitlines()


def test_probes_of_a_service_that_is_not_ready_are_no_refused_requests(make_app: MakeApp) -> None:
    app = make_app()
    TestClient(app).get("/readyz")
    (counter,) = [family for family in app.service.metrics.registry.collect() if family.name == "trilitenet_requests"]
    labels = [sample.labels for sample in counter.samples if sample.name.endswith("_total") and sample.value]
    assert [(entry["route"], entry["status"]) for entry in labels] == [("/readyz", "503")]
    refused = [text for text in _expressions() if 'status="503"' in text]
    assert len(refused) == 2
    for expression in refused:
        (routes,) = re.findall(r'trilitenet_requests_total\{route=~"([^"]*)",status="503"\}', expression)
        assert not any(re.fullmatch(routes, entry["route"]) for entry in labels)


def test_the_panels_do_not_overlap() -> None:
    dashboard = json.loads((ROOT / "monitoring/grafana/dashboards/trilitenet.json").read_text(encoding="utf-8"))
    taken: set[tuple[int, int]] = set()
    for panel in dashboard["panels"]:
        place = panel["gridPos"]
        cells = {(place["x"] + i, place["y"] + j) for i in range(place["w"]) for j in range(place["h"])}
        assert not taken & cells, panel["title"]
        assert max(x for x, _ in cells) < 24
        taken |= cells


def test_prometheus_and_grafana_find_each_other() -> None:
    (prometheus,) = _yaml("monitoring/prometheus.yml")
    assert prometheus["scrape_configs"][0]["static_configs"][0]["targets"] == ["trilitenet:8000"]
    (source,) = _yaml("monitoring/grafana/provisioning/datasources/prometheus.yaml")
    assert source["datasources"][0]["url"] == "http://prometheus:9090"
    dashboard = json.loads((ROOT / "monitoring/grafana/dashboards/trilitenet.json").read_text(encoding="utf-8"))
    assert {panel["datasource"]["uid"] for panel in dashboard["panels"]} == {source["datasources"][0]["uid"]}
