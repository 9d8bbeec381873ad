#include "thread_pool.hpp"

#include <unistd.h>

namespace meslam {

ThreadPool::~ThreadPool() {
    // After a fork the threads exist in the parent alone.
    if (owner_ != getpid()) {
        for (std::thread& worker : workers_) worker.detach();
        return;
    }
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        stopping_ = true;
    }
    work_ready_.notify_all();
    for (std::thread& worker : workers_) worker.join();
}

void ThreadPool::start_workers() {
    for (std::thread& worker : workers_) worker.detach();
    workers_.clear();
    owner_ = getpid();
    for (int index = 1; index < threads_; ++index) {
        workers_.emplace_back(&ThreadPool::work, this, index, generation_);
    }
}

void ThreadPool::run(const std::function<void(int)>& task) {
    if (threads_ == 1) {
        task(0);
        return;
    }
    if (owner_ != getpid()) start_workers();
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        task_ = &task;
        unfinished_ = threads_ - 1;
        ++generation_;
    }
    work_ready_.notify_all();
    task(0);
    std::unique_lock<std::mutex> lock(mutex_);
    work_done_.wait(lock, [this] { return unfinished_ == 0; });
}

void ThreadPool::work(int index, unsigned long seen) {
    std::unique_lock<std::mutex> lock(mutex_);
    while (true) {
        work_ready_.wait(lock, [&] { return stopping_ || generation_ != seen; });
        if (stopping_) return;
        seen = generation_;
        const std::function<void(int)>& task = *task_;
        lock.unlock();
        task(index);
        lock.lock();
        if (--unfinished_ == 0) work_done_.notify_one();
    }
}

}  // namespace meslam
