// Core of the C++ monitor, without a middleware: counts a node's messages, and makes a record of them once per period,
// with the fields of D3.2's code snippet 4 (schema: `python -m scan2sim.services.monitoring.record`). Header-only, C++17,
// Linux. `fastdds.hpp` connects it to Fast DDS; another middleware calls `meter()` of a `Reporter` for each message.
#pragma once

#include <ifaddrs.h>
#include <net/if.h>
#include <netdb.h>
#include <sys/statvfs.h>
#include <sys/timex.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <condition_variable>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <deque>
#include <fstream>
#include <functional>
#include <map>
#include <mutex>
#include <optional>
#include <random>
#include <set>
#include <sstream>
#include <string>
#include <thread>
#include <utility>
#include <vector>

namespace scan2sim {

// Settings of a monitor, named as in D3.2 (code snippet 3). `period`: seconds between two records; `window_size`: latest
// messages of each topic whose latency is averaged; `publisher_topic`: topic of the records.
struct MonitorSettings {
  std::string node_name;
  std::string node_namespace = "/";
  double period = 1.0;
  std::size_t window_size = 100;
  std::string publisher_topic = "monitor_data";
};

// Identifier of a publisher or subscription (RTPS GUID).
using Gid = std::array<std::uint8_t, 16>;

// A received message: bytes with its CDR header; nanoseconds since the epoch; `number`: counted by its publisher.
struct Arrival {
  std::size_t size = 0;
  std::int64_t received = 0;
  std::optional<std::int64_t> sent;
  Gid publisher{};
  std::optional<std::int64_t> number;
};

// A publisher or subscription of the monitored node.
struct Endpoint {
  std::string topic, type;
  bool is_publisher = false;
  Gid gid{};
  bool reliable = true, transient_local = false;
};

// Full name of a topic: "image" in the namespace "/robot" is "/robot/image".
inline std::string qualified(const std::string& topic, const std::string& node_namespace) {
  if (!topic.empty() && topic[0] == '/') return topic;
  return (node_namespace == "/" ? "" : node_namespace) + "/" + topic;
}

inline std::int64_t now_ns() {
  return std::chrono::duration_cast<std::chrono::nanoseconds>(std::chrono::system_clock::now().time_since_epoch()).count();
}

// Writes JSON; `null` for absent and non-finite numbers.
class Json {
 public:
  Json& key(const std::string& name) {
    separate();
    quote(name);
    out_ << ':';
    first_ = true;
    return *this;
  }
  Json& open(char bracket) { return separate(), out_ << bracket, first_ = true, *this; }
  Json& close(char bracket) { return out_ << bracket, first_ = false, *this; }
  Json& value(const std::string& text) { return separate(), quote(text), *this; }
  Json& value(const char* text) { return value(std::string(text)); }
  Json& value(bool flag) { return separate(), out_ << (flag ? "true" : "false"), *this; }
  Json& value(std::int64_t number) { return separate(), out_ << number, *this; }
  Json& value(std::size_t number) { return value(static_cast<std::int64_t>(number)); }
  Json& value(int number) { return value(static_cast<std::int64_t>(number)); }
  Json& value(double number) {
    if (!std::isfinite(number)) return null();
    char text[32];
    std::snprintf(text, sizeof text, "%.17g", number);
    return separate(), out_ << text, *this;
  }
  template <class T>
  Json& value(const std::optional<T>& maybe) {
    return maybe ? value(*maybe) : null();
  }
  Json& null() { return separate(), out_ << "null", *this; }
  std::string text() const { return out_.str(); }

 private:
  void separate() {
    if (!first_) out_ << ',';
    first_ = false;
  }
  void quote(const std::string& text) {
    out_ << '"';
    for (const char c : text) {
      if (c == '"' || c == '\\') {
        out_ << '\\' << c;
      } else if (static_cast<unsigned char>(c) < 0x20) {
        char code[8];
        std::snprintf(code, sizeof code, "\\u%04x", c);
        out_ << code;
      } else {
        out_ << c;
      }
    }
    out_ << '"';
  }
  std::ostringstream out_;
  bool first_ = true;
};

// Statistics of one direction of one topic over a period; latencies in nanoseconds.
struct Flow {
  std::string topic;
  bool incoming = false;
  std::int64_t messages = 0, bytes = 0;
  std::optional<std::int64_t> sent, lost;
  std::vector<std::int64_t> latencies;

  double mean_size() const { return messages ? static_cast<double>(bytes) / static_cast<double>(messages) : 0.0; }
};

inline std::optional<std::int64_t> mean(const std::vector<std::int64_t>& values) {
  if (values.empty()) return std::nullopt;
  long double sum = 0;
  for (const auto one : values) sum += static_cast<long double>(one);
  return static_cast<std::int64_t>(std::llround(sum / static_cast<long double>(values.size())));
}

inline std::optional<std::int64_t> p95(std::vector<std::int64_t> values) {
  if (values.empty()) return std::nullopt;
  const auto index = std::min(values.size() - 1, static_cast<std::size_t>(0.95 * static_cast<double>(values.size())));
  std::nth_element(values.begin(), values.begin() + static_cast<std::ptrdiff_t>(index), values.end());
  return values[index];
}

// Counts the messages of a node; thread-safe.
class Meter {
 public:
  // Latencies below this are discarded: clocks differ a little, larger differences are wrong timestamps.
  static constexpr std::int64_t kMinLatencyNs = -1'000'000'000;

  explicit Meter(std::size_t window) : window_(window) {}

  void published(const std::string& topic, std::size_t size) {
    const std::lock_guard<std::mutex> lock(mutex_);
    auto& flow = outgoing_[topic];
    ++flow.first;
    flow.second += static_cast<std::int64_t>(size);
  }

  void received(const std::string& topic, const Arrival& arrival) {
    const std::lock_guard<std::mutex> lock(mutex_);
    auto& counter = incoming_[topic];
    ++counter.messages;
    counter.bytes += static_cast<std::int64_t>(arrival.size);
    if (arrival.sent && arrival.received - *arrival.sent > kMinLatencyNs) {
      counter.latencies.push_back(arrival.received - *arrival.sent);
      if (counter.latencies.size() > window_) counter.latencies.pop_front();
    }
    if (!arrival.number) {
      counter.unnumbered = true;
      return;
    }
    const auto [found, is_new] = counter.sequences.try_emplace(arrival.publisher);
    auto& sequence = found->second;
    if (is_new) sequence.highest = sequence.reported = *arrival.number - 1;
    if (*arrival.number > sequence.highest) {
      sequence.missing += *arrival.number - sequence.highest - 1;
      sequence.highest = *arrival.number;
    } else if (sequence.missing) {
      --sequence.missing;  // arrived out of order
    }
  }

  // Flows since the last call, of all topics that ever had a message; the counters restart at zero.
  std::vector<Flow> read() {
    const std::lock_guard<std::mutex> lock(mutex_);
    std::vector<Flow> flows;
    for (auto& [topic, counts] : outgoing_) {
      flows.push_back({topic, false, counts.first, counts.second, {}, {}, {}});
      counts = {0, 0};
    }
    for (auto& [topic, counter] : incoming_) {
      Flow flow{topic, true, counter.messages, counter.bytes, {}, {}, {counter.latencies.begin(), counter.latencies.end()}};
      if (!counter.unnumbered && !counter.sequences.empty()) flow.sent = flow.lost = 0;
      for (auto one = counter.sequences.begin(); one != counter.sequences.end();) {
        auto& sequence = one->second;
        const auto sent = sequence.highest - sequence.reported;
        if (flow.sent) {
          *flow.sent += sent;
          *flow.lost += sequence.missing;
        }
        sequence.silent_periods = sent ? 0 : sequence.silent_periods + 1;
        sequence.reported = sequence.highest;
        sequence.missing = 0;
        one = sequence.silent_periods < kExpiryPeriods ? std::next(one) : counter.sequences.erase(one);
      }
      counter.messages = counter.bytes = 0;
      counter.latencies.clear();
      flows.push_back(std::move(flow));
    }
    return flows;
  }

 private:
  static constexpr int kExpiryPeriods = 1000;  // after which the counter of a silent publisher is deleted

  struct Sequence {
    std::int64_t highest = 0, reported = 0, missing = 0;
    int silent_periods = 0;
  };
  struct Incoming {
    std::int64_t messages = 0, bytes = 0;
    bool unnumbered = false;
    std::deque<std::int64_t> latencies;
    std::map<Gid, Sequence> sequences;
  };

  std::size_t window_;
  std::mutex mutex_;
  std::map<std::string, std::pair<std::int64_t, std::int64_t>> outgoing_;
  std::map<std::string, Incoming> incoming_;
};

// Load and addresses of this machine, with the fields of D3.2, section 3.1.
class HostMetrics {
 public:
  HostMetrics() { previous_ = cpu_times(); }

  // Writes the fields; CPU percent since the last call.
  void write(Json& json) {
    char name[256] = "";
    gethostname(name, sizeof name - 1);
    const auto addresses = local_ips();
    json.key("hostname").value(name).key("local ip").value(addresses.empty() ? "" : addresses[0]);
    json.key("local ips").open('[');
    for (const auto& one : addresses) json.value(one);
    json.close(']');
    const auto times = cpu_times();
    double busy = 0, all = 0;
    json.key("cpu times").open('{');
    for (std::size_t i = 0; i < times.size(); ++i) {
      json.key(kCpuStates[i]).value(times[i]);
      const double change = times[i] - previous_[i];
      all += change;
      if (i != 3 && i != 4) busy += change;  // all but idle and iowait
    }
    json.close('}').key("cpu percent").value(all > 0 ? 100 * busy / all : 0.0);
    previous_ = times;
    write_memory(json);
    write_disk(json);
  }

 private:
  static constexpr const char* kCpuStates[] = {"user", "nice", "system", "idle", "iowait", "irq", "softirq", "steal"};
  using CpuTimes = std::array<double, 8>;

  static CpuTimes cpu_times() {
    std::ifstream file("/proc/stat");
    std::string label;
    CpuTimes times{};
    file >> label;
    for (auto& one : times) {
      file >> one;
      one /= static_cast<double>(sysconf(_SC_CLK_TCK));
    }
    return times;
  }

  static void write_memory(Json& json) {
    std::ifstream file("/proc/meminfo");
    std::map<std::string, double> kib;
    std::string name, line;
    while (std::getline(file, line)) {
      std::istringstream words(line);
      double value = 0;
      if (words >> name >> value) kib[name] = value;
    }
    const double total = 1024 * kib["MemTotal:"], available = 1024 * kib["MemAvailable:"];
    json.key("virtual memory").open('{').key("total").value(total).key("available").value(available);
    json.key("percent").value(total > 0 ? 100 * (total - available) / total : 0.0);
    json.key("used").value(total - available).key("free").value(1024 * kib["MemFree:"]).close('}');
  }

  static void write_disk(Json& json) {
    struct statvfs disk {};
    statvfs("/", &disk);
    const double block = static_cast<double>(disk.f_frsize), total = block * static_cast<double>(disk.f_blocks);
    const double used = total - block * static_cast<double>(disk.f_bfree), free = block * static_cast<double>(disk.f_bavail);
    json.key("disk usage").open('[').value(total).value(used).value(free);
    json.value(used + free > 0 ? 100 * used / (used + free) : 0.0).close(']');
  }

  static std::vector<std::string> local_ips() {
    std::set<std::pair<int, std::string>> found;
    ifaddrs* all = nullptr;
    if (getifaddrs(&all) != 0) return {};
    for (const ifaddrs* one = all; one; one = one->ifa_next) {
      if (!one->ifa_addr || !(one->ifa_flags & IFF_UP) || (one->ifa_flags & IFF_LOOPBACK)) continue;
      const int family = one->ifa_addr->sa_family;
      if (family != AF_INET && family != AF_INET6) continue;
      char text[NI_MAXHOST];
      const auto size = family == AF_INET ? sizeof(sockaddr_in) : sizeof(sockaddr_in6);
      if (getnameinfo(one->ifa_addr, static_cast<socklen_t>(size), text, sizeof text, nullptr, 0, NI_NUMERICHOST) == 0)
        found.emplace(family, std::string(text).substr(0, std::string(text).find('%')));
    }
    freeifaddrs(all);
    std::vector<std::string> addresses;
    for (const auto& one : found) addresses.push_back(one.second);
    return addresses;
  }

  CpuTimes previous_{};
};

// Makes a record per period in a thread of its own, and a last one when it ends.
class Reporter {
 public:
  // What the middleware knows: the node's endpoints, and how many publishers and subscriptions there are on its topics.
  struct Graph {
    std::vector<Endpoint> endpoints;
    std::size_t publishers = 0, subscribers = 0;
  };

  // `graph` and `publish` are called in the thread; `publish` gets the record as a line of JSON.
  Reporter(MonitorSettings settings, std::function<Graph()> graph, std::function<void(const std::string&)> publish)
      : meter_(settings.window_size), settings_(std::move(settings)), graph_(std::move(graph)), publish_(std::move(publish)) {
    std::random_device random;
    for (int i = 0; i < 4; ++i) {
      char part[9];
      std::snprintf(part, sizeof part, "%08x", static_cast<unsigned>(random()));
      node_id_ += part;
    }
    thread_ = std::thread([this] { run(); });
  }
  ~Reporter() { stop(); }
  Reporter(const Reporter&) = delete;
  Reporter& operator=(const Reporter&) = delete;

  Meter& meter() { return meter_; }
  const MonitorSettings& settings() const { return settings_; }

  // Publishes the last record and ends the thread.
  void stop() {
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      ended_ = true;
    }
    wake_.notify_all();
    if (thread_.joinable()) thread_.join();
  }

 private:
  using Clock = std::chrono::steady_clock;

  void run() {
    const auto period = std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(settings_.period));
    auto began = Clock::now(), due = began + period;
    for (bool ended = false; !ended;) {
      {
        std::unique_lock<std::mutex> lock(mutex_);
        ended = wake_.wait_until(lock, due, [this] { return ended_; });
      }
      const auto now = Clock::now();
      publish_(record(std::max(1e-6, std::chrono::duration<double>(now - began).count())));
      began = now;
      due = std::max(due + period, now);
    }
  }

  std::string record(double seconds) {
    const auto flows = meter_.read();
    const auto graph = graph_();
    std::map<std::string, std::string> types;
    for (const auto& one : graph.endpoints) types[one.topic] = one.type;
    Flow out, in, both;
    for (const auto& flow : flows) {
      for (Flow* total : {flow.incoming ? &in : &out, &both}) {
        total->messages += flow.messages;
        total->bytes += flow.bytes;
      }
      in.latencies.insert(in.latencies.end(), flow.latencies.begin(), flow.latencies.end());
      if (flow.lost) in.lost = in.lost.value_or(0) + *flow.lost;
    }
    Json json;
    json.open('{').key("schema").value("scan2sim-monitor-1");
    json.key("record id").value(node_id_ + ":" + std::to_string(++number_));
    json.key("time").value(static_cast<double>(now_ns()) / 1e9).key("period").value(seconds);
    json.key("node name").value(settings_.node_name).key("node namespace").value(settings_.node_namespace);
    json.key("node id").value(node_id_);
    write_total(json, "", both, seconds);
    write_total(json, "outgoing ", out, seconds);
    write_total(json, "incoming ", in, seconds);
    json.key("latency (nanoseconds)").value(mean(in.latencies)).key("latency p95 (nanoseconds)").value(p95(in.latencies));
    json.key("clock synchronised").value(clock_synchronised()).key("lost messages").value(in.lost);
    json.key("publishers").value(graph.publishers).key("subscribers").value(graph.subscribers);
    json.key("topics").open('[');
    for (const auto& one : types) json.value(one.first);
    json.close(']').key("flows").open('[');
    for (const auto& flow : flows) write_flow(json, flow, types[flow.topic], seconds);
    json.close(']');
    host_.write(json);
    json.key("topics endpoint info").open('[');
    for (const auto& [topic, type] : types) {
      json.open('{').key("topic name").value(topic);
      for (const bool publishers : {true, false}) {
        json.key(publishers ? "publishers_info_by_topic" : "subscriptions_info_by_topic").open('[');
        for (const auto& one : graph.endpoints)
          if (one.topic == topic && one.is_publisher == publishers) write_endpoint(json, one);
        json.close(']');
      }
      json.close('}');
    }
    return json.close(']').close('}').text();
  }

  static void write_total(Json& json, const std::string& prefix, const Flow& flow, double seconds) {
    json.key(prefix + "bandwidth").value(static_cast<double>(flow.bytes) / seconds);
    json.key(prefix + "messages").value(flow.messages).key(prefix + "message size mean").value(flow.mean_size());
  }

  static void write_flow(Json& json, const Flow& flow, const std::string& type, double seconds) {
    json.open('{').key("topic").value(flow.topic).key("direction").value(flow.incoming ? "incoming" : "outgoing");
    json.key("type").value(type);
    write_total(json, "", flow, seconds);
    if (flow.incoming) {
      json.key("published messages").value(flow.sent).key("lost messages").value(flow.lost);
      json.key("latency (nanoseconds)").value(mean(flow.latencies));
      json.key("latency p95 (nanoseconds)").value(p95(flow.latencies));
    }
    json.close('}');
  }

  void write_endpoint(Json& json, const Endpoint& one) const {
    constexpr std::int64_t kInfinite = INT64_MAX;
    json.open('{').key("node name").value(settings_.node_name).key("node namespace").value(settings_.node_namespace);
    json.key("topic type").value(one.type).key("endpoint type").value(one.is_publisher ? "PUBLISHER" : "SUBSCRIPTION");
    json.key("GID").open('[');
    for (const auto byte : one.gid) json.value(static_cast<int>(byte));
    json.close(']').key("QoS profile").open('{');
    json.key("reliability").value(one.reliable ? "RELIABLE" : "BEST_EFFORT");
    json.key("durability").value(one.transient_local ? "TRANSIENT_LOCAL" : "VOLATILE");
    json.key("lifespan (nanoseconds)").value(kInfinite).key("deadline (nanoseconds)").value(kInfinite);
    json.key("liveliness").value("AUTOMATIC").key("liveliness lease duration (nanoseconds)").value(kInfinite);
    json.close('}').close('}');
  }

  static bool clock_synchronised() {
    timex clock{};
    return adjtimex(&clock) != TIME_ERROR && !(clock.status & STA_UNSYNC);
  }

  Meter meter_;
  HostMetrics host_;
  MonitorSettings settings_;
  std::function<Graph()> graph_;
  std::function<void(const std::string&)> publish_;
  std::string node_id_;
  std::int64_t number_ = 0;
  std::mutex mutex_;
  std::condition_variable wake_;
  bool ended_ = false;
  std::thread thread_;
};

}  // namespace scan2sim
