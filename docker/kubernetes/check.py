"""Checks the Kubernetes manifests, and Prometheus' configuration for them, without a cluster.

    check.py [VERSION …]

Each document of the manifests must satisfy the schema of each VERSION of Kubernetes, without unknown fields. The
manifests must also agree with the server and the learner: docs/operations.md has all settings, ports agree, the pod is
killed only after the server's grace period, and labels select the servers and the learners. Alerts must use metrics of
docs/monitoring.md. promtool checks the rules and the configuration. Run the script from the repository's root. If there
are faults, it prints them and ends with status 1.
"""

import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import kubernetes_validate
import yaml

MANIFESTS = [Path("docker/kubernetes/servers.yaml"), Path("docker/kubernetes/learners.yaml")]
PROMETHEUS = Path("docker/prometheus")
# Default versions of Kubernetes: the oldest and the newest for which kubernetes-validate has a schema.
VERSIONS = ["1.28.0", "1.37.0"]


def read() -> dict[tuple[str, str], dict[str, Any]]:
    """Reads the documents of all manifests. Returns them by kind and name."""
    documents = [document for path in MANIFESTS for document in yaml.safe_load_all(path.read_text())]
    return {(document["kind"], document["metadata"]["name"]): document for document in documents}


def schema_faults(documents: dict, versions: list[str]) -> list[str]:
    """Returns a line for each document that one of `versions` of Kubernetes would refuse."""
    faults = []
    for version in versions:
        for (kind, name), document in documents.items():
            try:
                kubernetes_validate.validate(document, version, strict=True)
            except kubernetes_validate.ValidationError as error:
                place = ".".join(str(part) for part in error.absolute_path)
                faults.append(f"{kind} {name}, Kubernetes {version}: {place}: {error.message}")
    return faults


def environment(container: dict) -> dict[str, str | None]:
    """Returns a container's environment variables. The value is `None` if Kubernetes will compute it."""
    return {variable["name"]: variable.get("value") for variable in container.get("env", [])}


def server_faults(documents: dict) -> list[str]:
    """Returns a line for each part of the manifests that disagrees with the server's image or settings."""
    faults = []
    deployment = documents["Deployment", "perturb-servers"]["spec"]
    pod = deployment["template"]["spec"]
    labels = deployment["template"]["metadata"]["labels"]
    annotations = deployment["template"]["metadata"]["annotations"]
    (container,) = pod["containers"]
    variables = environment(container)
    known = set(re.findall(r"`(PERTURB_SERVER_[A-Z_]+)`", Path("docs/operations.md").read_text()))
    faults += [f"{name} is no setting of the server" for name in variables if name not in known]
    ports = {port["name"]: port["containerPort"] for port in container["ports"]}
    image = Path("docker/server.Dockerfile").read_text()
    if f"EXPOSE {ports['grpc']}\n" not in image:
        faults.append(f"the image does not listen on {ports['grpc']}")
    if variables["PERTURB_SERVER_METRICS"] != f"tcp://0.0.0.0:{ports['metrics']}":
        faults.append(f"metrics are at {variables['PERTURB_SERVER_METRICS']}, the pod says {ports['metrics']}")
    if annotations["prometheus.io/port"] != str(ports["metrics"]):
        faults.append(f"Prometheus is sent to {annotations['prometheus.io/port']}, metrics are at {ports['metrics']}")
    if pod["terminationGracePeriodSeconds"] <= int(variables["PERTURB_SERVER_GRACE_SECONDS"] or 0):
        faults.append("the pod is killed before the server's grace period is over")
    if f"--uid {pod['securityContext']['runAsUser']} " not in image:
        faults.append(f"the image has no user {pod['securityContext']['runAsUser']}")
    service = documents["Service", "perturb-servers"]["spec"]
    for selector in (
        deployment["selector"]["matchLabels"],
        service["selector"],
        documents["PodDisruptionBudget", "perturb-servers"]["spec"]["selector"]["matchLabels"],
        documents["NetworkPolicy", "perturb-servers"]["spec"]["podSelector"]["matchLabels"],
    ):
        if selector.items() - labels.items():
            faults.append(f"{selector} selects no server")
    wrong = [port["port"] for port in service["ports"] if ports[port["name"]] != port["port"]]
    return faults + [f"port {port} is not that of the pod" for port in wrong]


def learner_faults(documents: dict) -> list[str]:
    """Returns a line for each part of the learners' manifest that disagrees with the servers' manifest or the image."""
    job = documents["Job", "perturb-learners"]["spec"]
    (container,) = job["template"]["spec"]["containers"]
    arguments = container["args"]
    faults = []
    server = arguments[arguments.index("--server") + 1]
    (service,) = [name for kind, name in documents if kind == "Service"]
    port = documents["Service", service]["spec"]["ports"][0]["port"]
    if server != f"{service}:{port}":
        faults.append(f"learners look for servers at {server}, the Service is {service}:{port}")
    if not Path(arguments[1].removeprefix("/")).is_file():
        faults.append(f"the image has no {arguments[1]}")
    (admitted,) = documents["NetworkPolicy", "perturb-servers"]["spec"]["ingress"][0]["from"]
    if admitted["podSelector"]["matchLabels"].items() - job["template"]["metadata"]["labels"].items():
        faults.append("the NetworkPolicy of the servers does not admit learners")
    return faults


def metric_faults() -> list[str]:
    """Returns a line for each alert without advice in docs/clusters.md, and for each unknown metric in an alert."""
    known = set(re.findall(r"`((?:perturb|process)_[a-z_]+)`", Path("docs/monitoring.md").read_text()))
    rules = [
        rule for group in yaml.safe_load((PROMETHEUS / "alerts.yml").read_text())["groups"] for rule in group["rules"]
    ]
    documented = Path("docs/clusters.md").read_text()
    unexplained = [rule["alert"] for rule in rules if f"`{rule['alert']}`" not in documented]
    faults = [f"docs/clusters.md does not say what to do about {alert}" for alert in unexplained]
    for rule in rules:
        for name in re.findall(r"\b(?:perturb|process)_[a-z_]+", rule["expr"]):
            if re.sub(r"_(bucket|sum|count)$", "", name) not in known and name not in known:
                faults.append(f"{rule['alert']}: there is no metric {name}")
    return faults


def promtool_faults() -> list[str]:
    """Returns promtool's complaints about the configuration of Prometheus.

    Debian's promtool cannot discover targets in Kubernetes, so a fixed target replaces them.
    """
    config = yaml.safe_load((PROMETHEUS / "kubernetes.yml").read_text())
    config["rule_files"] = [str((PROMETHEUS / name).resolve()) for name in config["rule_files"]]
    for job in config["scrape_configs"]:
        del job["kubernetes_sd_configs"]
        job["static_configs"] = [{"targets": ["127.0.0.1:9447"]}]
    with tempfile.NamedTemporaryFile("w", suffix=".yml") as file:
        yaml.safe_dump(config, file)
        file.flush()
        checked = subprocess.run(["promtool", "check", "config", file.name], capture_output=True, text=True)
    return [f"promtool: {checked.stdout}{checked.stderr}"] if checked.returncode else []


def main() -> None:
    """Runs all checks, for the versions of Kubernetes in the arguments or else for `VERSIONS`."""
    versions = sys.argv[1:] or VERSIONS
    documents = read()
    faults = schema_faults(documents, versions)
    faults += server_faults(documents) + learner_faults(documents) + metric_faults() + promtool_faults()
    if faults:
        sys.exit("\n".join(faults))
    print(f"{len(documents)} documents satisfy Kubernetes {' and '.join(versions)}, and agree with the server")


if __name__ == "__main__":
    main()
